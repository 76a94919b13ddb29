"""One run of a study in a worker: plain settings in, the results of a row out; nothing else leaves the process."""

import json
import tempfile
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from _exploration import ExplorationSettings, explore, prepare
from _study import Run, is_success, key_of, world_digest
from _study_crash import crashed

from coopslam.errors import BadInput
from coopslam.io.toml import from_mapping
from sim.world import world_names

SCORES = ("ate_rmse_m", "heading_rmse_rad", "nees_mean", "crlb_ratio")
_one_at_a_time = threading.Lock()  # a Dask worker may have several threads; explorations share nothing, but the clock


def job_of(run: Run, scratch: Path, keep: Path | None = None) -> dict:
    """The run in plain types, complete enough for a machine that has the repository and nothing else.

    scratch: where temporary run directories go, if it exists there.  keep: parent of run directories that stay.
    """
    own = None if run.world.source in world_names() else run.world.geojson
    return {
        "key": run.key,
        "settings": run.settings,
        "world_name": run.world.name,
        "geojson": own,
        "scratch": str(scratch),
        "keep": None if keep is None else str(keep / run.key),
    }


def run_job(job: dict) -> dict:
    """Explore; the row's results by column. An exception becomes a row of its own."""
    with _one_at_a_time:
        began = time.perf_counter()
        try:
            with _run_directory(job) as out:
                row = _results(job, out)
        except Exception as error:  # the study goes on whatever this run did
            row = crashed("".join(traceback.format_exception_only(error)))
        return row | {"seconds": time.perf_counter() - began}


@contextmanager
def _run_directory(job: dict) -> Iterator[Path]:
    """A directory for the run's files: deleted afterwards unless runs are kept."""
    if job["keep"] is not None:
        out = Path(job["keep"])
        out.mkdir(parents=True, exist_ok=True)
        yield out
        return
    scratch = job["scratch"] if Path(job["scratch"]).is_dir() else None
    with tempfile.TemporaryDirectory(prefix="run-", dir=scratch, ignore_cleanup_errors=True) as out:
        yield Path(out)


def _results(job: dict, out: Path) -> dict:
    settings = dict(job["settings"])
    if job["geojson"] is not None:
        path = out / "world" / f"{job['world_name']}.geojson"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(job["geojson"]), encoding="utf-8")
        settings["world"] = str(path)
    ready = prepare(from_mapping(ExplorationSettings, settings, f"run {job['key']}"))
    if key_of(ready.settings, world_digest(ready.world)) != job["key"]:
        raise BadInput("the worker has another version of the program or of the world than the study")
    return row_of(explore(ready, out).summary)


def row_of(summary: dict) -> dict:
    """A summary as columns; what it does not have is left out."""
    travel_m = summary.get("travel_m")
    row = {
        "outcome": summary["outcome"],
        "outcome_reason": " ".join(summary["outcome_reason"].split()),
        "success": is_success(summary),
        "vertices": summary.get("vertices"),
        "triangles": summary.get("triangles"),
        "moves": summary.get("moves"),
        "role_exchanges": summary.get("role_exchanges"),
        "travel_m": sum(travel_m.values()) if travel_m else None,
        "travel_over_perimeter": summary.get("travel_over_perimeter"),
        "covered_fraction": summary.get("covered_fraction"),
        "vertex_rmse_m": summary.get("vertex_rmse_m"),
        "vertex_nees": summary.get("vertex_nees_mean"),
    }
    for name, scores in summary.get("estimators", {}).items():
        row |= {f"{name}.{score}": scores.get(score) for score in SCORES}
    return {name: value for name, value in row.items() if value is not None}
