"""What pyproject.toml promises is what requirements.lock pins, and every package is listed."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
LOCK = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
TEST_LOCK = (ROOT / "requirements-test.lock").read_text(encoding="utf-8").splitlines()


def normalized(requirement: str) -> str:
    name, version = requirement.split("==")
    return f"{re.sub(r'[-_.]+', '-', name).lower()}=={version}"


def test_the_lock_pins_every_dependency_at_the_same_version():
    project = PROJECT["project"]
    wanted = project["dependencies"] + project["optional-dependencies"]["dev"] + PROJECT["build-system"]["requires"]
    assert len(wanted) >= 15
    assert {normalized(item) for item in wanted} <= {normalized(line) for line in LOCK}


def test_what_only_tests_need_is_pinned_apart():
    wanted = PROJECT["project"]["optional-dependencies"]["test"]
    assert {normalized(item) for item in wanted} <= {normalized(line) for line in TEST_LOCK}
    assert not {line.split("==")[0] for line in LOCK} & {line.split("==")[0] for line in TEST_LOCK}


def test_the_locks_say_names_and_versions_only():
    assert [line for line in LOCK + TEST_LOCK if not re.fullmatch(r"[a-z0-9_.-]+==[0-9][0-9a-z.]*", line)] == []


def test_every_package_is_listed():
    paths = [path.parent for top in ("coopslam", "sim", "tracker") for path in (ROOT / top).rglob("*.py")]
    found = {path.relative_to(ROOT).as_posix().replace("/", ".") for path in paths}
    assert found == set(PROJECT["tool"]["setuptools"]["packages"])
