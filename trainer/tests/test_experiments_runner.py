"""Many units in real processes, with work that is not training."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from edge_runtime.errors import UserError
from trainer.experiments.runner import ERROR_FILE, FAILED, run_units
from trainer.experiments.work import FINISHED, STOPPED, Task
from trainer.tests.experiments import UNIT, store_in


def pretend(task, on_episode) -> str:
    """What is done depends on the seed; each leaves a file with its process."""
    seed = task.unit.seed
    directory = task.store.runs
    directory.mkdir(parents=True, exist_ok=True)
    (directory / f"pid_{seed}").write_text(str(os.getpid()))
    on_episode(1)
    if seed == 11:
        raise ZeroDivisionError("one\nover none")
    if seed == 12:
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 13:
        raise UserError("no such human")
    if seed >= 100:
        time.sleep(60.0)
    if time.time() > task.stop_at_s - 3600.0:
        return STOPPED
    on_episode(3)
    return FINISHED


def tasks(directory, *seeds, **options):
    return [Task(replace(UNIT, seed=seed), store_in(directory), **options) for seed in seeds]


def test_a_unit_that_fails_is_one_line_and_takes_no_other_with_it(tmp_path, capsys):
    tally = run_units(tasks(tmp_path, 11, 12, 13, 1, 2), jobs=2, function=pretend)
    assert (tally.count(FINISHED), tally.count(FAILED), tally.total) == (2, 3, 5)
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("failed")]
    crashed, killed, refused = sorted(lines)
    assert "seed 11: ZeroDivisionError: one over none (" in crashed
    assert crashed.endswith(f"{ERROR_FILE})")
    assert "seed 12: its process died (exit status -9)" in killed
    assert refused.endswith("seed 13: no such human")
    (kept,) = tmp_path.rglob(ERROR_FILE)
    assert "raise ZeroDivisionError" in kept.read_text()


def test_each_unit_has_a_process_of_its_own(tmp_path):
    run_units(tasks(tmp_path, 1, 2, 3), jobs=2, function=pretend)
    processes = {path.read_text() for path in (tmp_path / "runs").glob("pid_*")}
    assert len(processes | {str(os.getpid())}) == 4


def test_nothing_is_begun_after_the_deadline(tmp_path):
    tally = run_units(tasks(tmp_path, 1, 2, stop_at_s=time.time() - 1.0), 1, function=pretend)
    assert tally.count(STOPPED) == 2
    assert not list(tmp_path.rglob("pid_*"))


def test_a_unit_that_stopped_is_counted_as_such(tmp_path):
    tally = run_units(tasks(tmp_path, 1, stop_at_s=time.time() + 600.0), 1, function=pretend)
    assert (tally.count(STOPPED), tally.count(FINISHED)) == (1, 0)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL], ids=["interrupt", "kill"])
def test_no_process_outlives_the_one_that_started_it(tmp_path, how):
    program = (
        "import sys; from pathlib import Path\n"
        "from trainer.experiments.runner import run_units\n"
        "from trainer.tests.test_experiments_runner import pretend, tasks\n"
        "if __name__ == '__main__':\n"
        "    run_units(tasks(Path(sys.argv[1]), 100, 101), 2, pretend)\n"
    )
    script = tmp_path / "script.py"
    script.write_text(program)
    root = Path(__file__).parents[2]
    paths = os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])
    parent = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path)],
        env={**os.environ, "PYTHONPATH": paths},
        stderr=subprocess.DEVNULL,
    )
    children = _wait_for(lambda: sorted((tmp_path / "runs").glob("pid_*")), 2)
    pids = [int(_wait_for(path.read_text, 1)) for path in children]
    parent.send_signal(how)
    parent.wait(30.0)
    deadline_s = time.monotonic() + 30.0
    while any(map(_alive, pids)):
        assert time.monotonic() < deadline_s
        time.sleep(0.05)


def _wait_for(look, length):
    deadline_s = time.monotonic() + 60.0
    while len(look()) < length:
        assert time.monotonic() < deadline_s
        time.sleep(0.05)
    return look()


def _alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"
