"""What the README shows works as it stands there."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parent.parent
STEP_S, SPEED, TURN = 0.5, 0.4, 0.3  # s, m/s, rad/s: both robots drive circles


def where(robot: int, stamp_s: float) -> tuple[float, float, float]:
    """x, y, heading on a circle through the robot's start."""
    start_x, start_y, heading = ((0.0, 0.0, 0.0), (1.5, 0.5, 2.0))[robot]
    now, radius = heading + TURN * stamp_s, SPEED / TURN
    return start_x + radius * (np.sin(now) - np.sin(heading)), start_y + radius * (np.cos(heading) - np.cos(now)), now


def lines() -> list[str]:
    """Two robots that start somewhere, drive circles, and see three landmarks; no noise."""
    landmarks = {"oak": (3.0, 1.0), "elm": (-1.0, 3.0), "ash": (1.0, -2.0)}
    found = []
    for k in range(40):
        stamp = k * STEP_S
        for robot in range(2):
            chord = 2 * SPEED / TURN * np.sin(TURN * STEP_S / 2)
            found.append(f"odometry,{stamp},{stamp + STEP_S},r{robot},{chord},{TURN * STEP_S}")
            x, y, heading = where(robot, stamp + STEP_S)
            for name, point in landmarks.items():
                dx, dy = point[0] - x, point[1] - y
                bearing = np.arctan2(dy, dx) - heading
                found.append(f"sees,{stamp + STEP_S},r{robot},{name},{bearing},{np.hypot(dx, dy)}")
    return found


def test_the_format_of_ones_own_is_read_and_replayed(tmp_path):
    code = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)[1]
    assert len(list(filter(str.strip, code.splitlines()))) <= 30
    (tmp_path / "my_format.py").write_text(code, encoding="utf-8")
    (tmp_path / "drive.csv").write_text("\n".join(lines()), encoding="utf-8")
    command = [sys.executable, str(ROOT / "scripts/replay.py"), str(tmp_path / "drive.csv"), "--figures", "none"]
    command += ["--source", f"{tmp_path / 'my_format.py'}:CsvLog", "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert summary["robots"] == ["r0", "r1"] and summary["landmarks"] == ["ash", "elm", "oak"]
    ends = [np.loadtxt(tmp_path / f"out/trajectories/r{robot}.tum")[-1, 1:3] for robot in range(2)]
    for robot in range(2):  # the first robot's start is the origin of truth and estimate
        np.testing.assert_allclose(ends[robot], where(robot, 20.0)[:2], atol=1e-4)
