import sys

import pytest

from benchmarks.large import lines, run_by_stage, total
from tidefield.errors import RunError

STAGES = """
import sys, time
print("12:00:00 one: started", file=sys.stderr, flush=True)
end = time.process_time() + 1.2
while time.process_time() < end: pass
time.sleep(0.8)  # until this is counted, also on a busy machine
print("12:00:00 two: started", file=sys.stderr, flush=True)
held = bytearray(40_000_000)
time.sleep(0.8)
"""


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_time_and_memory_are_counted_for_the_stage_that_runs():
    stages = run_by_stage([sys.executable, "-c", STAGES], threads=1)
    assert list(stages)[-2:] == ["one", "two"]
    assert stages["one"]["cpu_seconds"] > 0.8
    assert stages["two"]["cpu_seconds"] < 0.5
    assert stages["two"]["seconds"] > 0.6
    assert stages["two"]["peak_bytes"] > 40e6 > stages["one"]["peak_bytes"]
    assert total(stages)["peak_bytes"] == stages["two"]["peak_bytes"]
    found = {
        "placed": 3, "photographs": 4, "points": 1000, "reprojection_px": 0.5, "stages": stages,
        "off_m": {"horizontal": 1.0, "vertical": 2.0},
        "fitted_m": {"horizontal": 0.1, "vertical": 0.2, "largest": 0.3},
    }  # fmt: skip
    assert lines(found)[0] == "3 of 4 photographs, 1,000 points, 0.50 px"


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_command_that_fails_says_why():
    with pytest.raises(RunError, match="status 3: no photographs"):
        run_by_stage([sys.executable, "-c", "import sys; print('no photographs', file=sys.stderr); sys.exit(3)"], 1)
