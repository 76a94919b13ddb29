"""The run directory: what is deleted to make room for a run, and what is not."""

import pytest

from coopslam.errors import BadInput
from coopslam.report.run_directory import prepare_run_directory


def fill(directory, *names: str) -> None:
    for name in names:
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        (directory / name).write_text(name, encoding="utf-8")


def files(directory) -> list[str]:
    return sorted(path.relative_to(directory).as_posix() for path in directory.rglob("*") if path.is_file())


def test_force_deletes_a_run_and_nothing_else(tmp_path):
    run = ["config.toml", "log.mcap", "summary.json", "truth/robot0.tum", "figures/map.png", "trajectories/r.tum"]
    run += ["plans/shortest/paths.geojson", "exports/map.pgm"]
    mine = ["notes.txt", "plans/shortest/my.txt", "figures/drawing.svg", "truth/deep/er.json", "thesis/figures/map.png"]
    fill(tmp_path, *run, *mine)
    prepare_run_directory(tmp_path, force=True)
    assert files(tmp_path) == sorted(mine) and not (tmp_path / "trajectories").exists()


@pytest.mark.parametrize("also", [[], ["config.toml"], ["log.mcap"]])
def test_force_leaves_folders_alone_where_there_is_no_run(also, tmp_path):
    mine = ["figures/map.png", "truth/robot0.tum", "trajectories/a.json"]
    fill(tmp_path, *mine, *also)
    with pytest.raises(BadInput, match="--force"):
        prepare_run_directory(tmp_path, force=False)
    prepare_run_directory(tmp_path, force=True)
    assert files(tmp_path) == sorted(mine)


def test_a_linked_folder_is_not_emptied(tmp_path):
    fill(tmp_path, "run/config.toml", "run/log.mcap", "elsewhere/map.png")
    (tmp_path / "run" / "figures").symlink_to(tmp_path / "elsewhere")
    prepare_run_directory(tmp_path / "run", force=True)
    assert files(tmp_path / "elsewhere") == ["map.png"]


@pytest.mark.parametrize("name", ["figures", "summary.json/below"])
def test_files_and_folders_that_are_not_a_runs_are_refused(name, tmp_path):
    fill(tmp_path, "config.toml", "log.mcap", name)
    with pytest.raises(BadInput, match="not what a run writes"):
        prepare_run_directory(tmp_path, force=True)
    assert files(tmp_path) == sorted(["config.toml", "log.mcap", name])


@pytest.mark.parametrize("name", ["n" * 300, "nul\0"])
def test_a_name_that_cannot_be_is_bad_input(name, tmp_path):
    with pytest.raises(BadInput, match="--out"):
        prepare_run_directory(tmp_path / name, force=False)
