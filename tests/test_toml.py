import tomllib
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import numpy as np
import pytest

from coopslam.errors import BadInput
from coopslam.io.toml import dump_toml, from_mapping, load_toml, to_mapping


class Strategy(StrEnum):
    NEAREST = "nearest"
    DEPTH = "depth-first"


@dataclass(frozen=True)
class Tracker:
    range_sigma_m: float = 0.01
    max_range_m: float | None = None
    samples: int = 5

    def __post_init__(self):
        if self.range_sigma_m <= 0:
            raise BadInput(f"range_sigma_m is {self.range_sigma_m}; more than zero expected")


@dataclass(frozen=True)
class Sensors:
    tracker: Tracker = Tracker()
    finders: tuple[Tracker, ...] = ()
    bias: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Settings:
    world: str
    seed: int = 0
    verbose: bool = False
    strategy: Strategy = Strategy.NEAREST
    figures: Literal["none", "static"] = "static"
    sensors: Sensors = Sensors()
    speeds: dict[str, float] = field(default_factory=dict)
    robots: list[str] = field(default_factory=lambda: ["a", "b"])


FULL = Settings(
    world='say "hi"\n\\ é',
    seed=2**62,
    verbose=True,
    strategy=Strategy.DEPTH,
    figures="none",
    sensors=Sensors(Tracker(0.1 + 0.2, 12.5), (Tracker(1e-9), Tracker()), (1.0, -2.5e300)),
    speeds={"a": 0.1, "b c": 1 / 3},
    robots=[],
)


def test_settings_come_back_the_same_through_tomllib():
    text = dump_toml(to_mapping(FULL))
    assert tomllib.loads(text) == to_mapping(FULL)
    assert from_mapping(Settings, tomllib.loads(text), "c.toml") == FULL


def test_defaults_and_integers_for_floats():
    settings = from_mapping(Settings, {"world": "w", "sensors": {"tracker": {"range_sigma_m": 1}}}, "c.toml")
    assert settings == Settings("w", sensors=Sensors(Tracker(1.0)))
    assert type(settings.sensors.tracker.range_sigma_m) is float


def test_none_is_left_out_and_numpy_is_plain():
    assert dump_toml({"a": None, "b": {"c": None, "d": 1}}) == "[b]\nd = 1\n"
    assert "max_range_m" not in to_mapping(Tracker())
    assert to_mapping(Tracker(np.float64(0.5), samples=np.int64(3))) == {"range_sigma_m": 0.5, "samples": 3}


def test_a_none_that_toml_cannot_say_is_refused():
    @dataclass(frozen=True)
    class Limited:
        limit_m: float | None = 5.0

    assert to_mapping(Limited()) == {"limit_m": 5.0}
    with pytest.raises(ValueError, match=r"Limited\.limit_m is None"):
        to_mapping(Limited(None))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "c.toml: no key 'world'; expected world, seed"),
        ("wrld = 'w'", "c.toml: unknown key 'wrld'; known keys: world, seed, verbose"),
        ("world = 3", "c.toml: world: expected text, got 3"),
        ("world = 'w'\nseed = 1.5", "c.toml: seed: expected integer, got 1.5"),
        (
            "world = 'w'\nseed = 9223372036854775808",
            "c.toml: seed: expected integer of 64 bits, got 9223372036854775808",
        ),
        (f"world = 'w'\nseed = 0x{'f' * 5000}", "c.toml: seed: expected integer of 64 bits, got a number without end"),
        (f"world = 'w'\nseed = '{'x' * 5000}'", f"c.toml: seed: expected integer, got '{'x' * 56}..."),
        (f"world = 'w'\n{'x' * 5000} = 1", f"c.toml: unknown key '{'x' * 56}...; known keys"),
        ("world = 'w'\nseed = true", "c.toml: seed: expected integer, got True"),
        ("world = 'w'\nverbose = 1", "c.toml: verbose: expected true or false, got 1"),
        ("world = 'w'\nstrategy = 'far'", "c.toml: strategy: expected one of 'nearest', 'depth-first', got 'far'"),
        ("world = 'w'\nfigures = ['all']", "c.toml: figures: expected one of 'none', 'static', got ['all']"),
        ("world = 'w'\nrobots = 'ab'", "c.toml: robots: expected a list, got 'ab'"),
        ("world = 'w'\nsensors = 3", "c.toml: [sensors] expected a table, got 3"),
        ("world = 'w'\nspeeds.a = 'fast'", "c.toml: speeds.a: expected number, got 'fast'"),
        ("world = 'w'\n[sensors]\nbias = [1, 2, 3]", "c.toml: sensors.bias: expected a list of 2, got [1, 2, 3]"),
        (
            "world = 'w'\n[sensors.tracker]\nrange = 1",
            "c.toml: [sensors.tracker] unknown key 'range'; known keys: range_",
        ),
        (
            "world = 'w'\n[sensors.tracker]\nrange_sigma_m = 'abc'",
            "c.toml: sensors.tracker.range_sigma_m: expected number, got 'abc'",
        ),
        (
            "world = 'w'\n[sensors.tracker]\nrange_sigma_m = true",
            "c.toml: sensors.tracker.range_sigma_m: expected number, got True",
        ),
        (
            "world = 'w'\n[sensors.tracker]\nmax_range_m = nan",
            "c.toml: sensors.tracker.max_range_m: expected finite number, got nan",
        ),
        (
            "world = 'w'\n[sensors.tracker]\nrange_sigma_m = -1",
            "c.toml: sensors.tracker.range_sigma_m is -1.0; more than zero expected",
        ),
    ],
)
def test_what_is_wrong_is_said_with_its_place(text, expected):
    with pytest.raises(BadInput) as caught:
        from_mapping(Settings, tomllib.loads(text), "c.toml")
    assert str(caught.value).startswith(expected)
    assert "\n" not in str(caught.value)


def test_an_annotation_that_settings_cannot_hold_is_a_bug_and_says_so():
    @dataclass(frozen=True)
    class Odd:
        callback: complex

    with pytest.raises(TypeError, match="complex"):
        from_mapping(Odd, {"callback": 1}, "c.toml")


@pytest.mark.parametrize(
    ("content", "expected"),
    [(b"a = 1\nb = = 2\n", "line 2"), (b"a = 1\na = 2\n", "line 2"), (b"\xff\xfe", "not a text file")],
)
def test_broken_files(tmp_path, content, expected):
    path = tmp_path / "c.toml"
    path.write_bytes(content)
    with pytest.raises(BadInput, match=expected) as caught:
        load_toml(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


def test_files(tmp_path):
    with pytest.raises(BadInput, match="cannot read"):
        load_toml(tmp_path / "none.toml")
    (tmp_path / "c.toml").write_text(dump_toml(to_mapping(FULL)), encoding="utf-8")
    assert load_toml(tmp_path / "c.toml") == to_mapping(FULL)


@dataclass(frozen=True)
class Gate:
    limit: float = field(default=9.0, metadata={"infinite": True})
    reach_m: float = 1.0


def test_infinity_is_read_and_written_where_it_means_something():
    gate = from_mapping(Gate, tomllib.loads("limit = inf"), "c.toml")
    assert gate == Gate(np.inf)
    assert dump_toml(to_mapping(gate)) == "limit = inf\nreach_m = 1.0\n"
    assert from_mapping(Gate, tomllib.loads(dump_toml(to_mapping(gate))), "c.toml") == gate
    for text in ("limit = -inf", "limit = nan", "reach_m = inf"):
        with pytest.raises(BadInput, match=f"c.toml: {text.split()[0]}: expected finite number"):
            from_mapping(Gate, tomllib.loads(text), "c.toml")


def test_a_byte_order_mark_is_no_part_of_the_settings(tmp_path):
    (tmp_path / "c.toml").write_text("seed = 3\n", encoding="utf-8-sig")
    assert load_toml(tmp_path / "c.toml") == {"seed": 3}
