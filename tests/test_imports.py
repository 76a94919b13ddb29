"""Who may import whom (DESIGN section 1), read off the source with ast."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LAYERS = [  # lower first
    *("errors", "se2", "records", "odometry_noise"),
    *("estimation", "exploration", "planning", "evaluation", "report"),
]
VOCABULARY = [*(f"coopslam.{layer}" for layer in LAYERS[:4]), "coopslam.exploration.moves"]
OURS = ["coopslam", "sim", "tracker", "scripts", "tests"]


def imports(source: str, path: str) -> Iterator[str]:
    """Dotted names a file imports, relative ones resolved; `from a import b` counts as a.b."""
    package = path.split("/")[:-1]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base += [node.module] if node.module else []
            yield from (".".join([*base, alias.name]) for alias in node.names)


def within(name: str, prefixes: list[str]) -> bool:
    return any(name == prefix or name.startswith(prefix + ".") for prefix in prefixes)


def allowed(path: str) -> list[str]:
    """What of ours the file at `path` may import."""
    top, part = path.removesuffix(".py").split("/")[:2]
    if top == "sim":
        return ["sim", "tracker", *VOCABULARY]
    if top == "tracker":
        return ["tracker", "coopslam.io.toml", *VOCABULARY]
    if top == "coopslam" and part == "io":
        return ["coopslam.io", *VOCABULARY[:4]]
    if top == "coopslam" and part in LAYERS:
        return [f"coopslam.{layer}" for layer in LAYERS[: LAYERS.index(part) + 1]] + (
            ["coopslam.io"] if part == "report" else []
        )
    return OURS if top in ("scripts", "tests") else []


def violations(source: str, path: str) -> list[str]:
    names = list(imports(source, path))
    bad = [name for name in names if within(name, OURS) and not within(name, allowed(path))]
    if not path.startswith(("coopslam/report/", "tests/")):
        bad += [name for name in names if within(name, ["matplotlib", "mpl_toolkits"])]
    return [f"{path} imports {name}" for name in bad]


def test_imports_point_one_way():
    paths = [path.relative_to(ROOT).as_posix() for top in OURS for path in (ROOT / top).rglob("*.py")]
    assert len(paths) > 15
    assert [line for path in paths for line in violations((ROOT / path).read_text(encoding="utf-8"), path)] == []


def test_datasets_hold_no_python():
    assert (ROOT / "datasets").is_dir()
    assert list((ROOT / "datasets").rglob("*.py")) == []


@pytest.mark.parametrize(
    ("path", "source", "count"),
    [
        ("coopslam/estimation/batch.py", "import sim.world", 1),
        ("coopslam/estimation/batch.py", "from ..exploration import moves", 1),
        ("coopslam/estimation/batch.py", "from .. import report, records", 1),
        ("coopslam/estimation/batch.py", "from . import keys\nfrom ..se2 import Pose2\nimport numpy", 0),
        ("coopslam/exploration/moves.py", "def f():\n    from coopslam.evaluation.errors import ate", 1),
        ("coopslam/records.py", "from coopslam.estimation.keys import key", 1),
        ("coopslam/records.py", "from .se2 import Pose2", 0),
        ("coopslam/io/tum.py", "from coopslam.exploration.moves import Side", 1),
        ("coopslam/io/tum.py", "from coopslam.records import Odometry\nimport mcap", 0),
        ("coopslam/planning/paths.py", "import matplotlib.pyplot as plt", 1),
        ("coopslam/report/figures.py", "import matplotlib.pyplot as plt\nfrom coopslam.evaluation import errors", 0),
        ("coopslam/newcomer.py", "from coopslam.records import Odometry", 1),
        ("coopslam/__init__.py", "from coopslam import records", 1),
        ("sim/world.py", "from coopslam.exploration.moves import Side\nfrom tracker import target", 0),
        ("sim/world.py", "from coopslam.exploration.free_map import FreeMap", 1),
        ("sim/world.py", "import coopslam", 1),
        ("tracker/target.py", "from sim.world import World", 1),
        ("tracker/data_sheet.py", "from coopslam.io.toml import load_toml\nfrom coopslam.io import log", 1),
        ("scripts/run.py", "import sim.world, coopslam.report.html", 0),
    ],
)
def test_the_check_itself(path, source, count):
    assert len(violations(source, path)) == count
