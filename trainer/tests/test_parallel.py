import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from edge_runtime.util import UserError
from trainer.__main__ import main
from trainer.drivers import load_driver, make_environment
from trainer.evaluation import drive_episodes
from trainer.human.model import HumanModel, HumanModelConfig
from trainer.parallel import WORTH_STARTING, choose_jobs, drive_episodes_in_parallel
from trainer.parallel import cores as parallel_cores


@pytest.fixture
def policy(tmp_path):
    """A network of random weights: all of its digits count."""
    model = HumanModel(HumanModelConfig(frames=2), seed=1)
    model.save(tmp_path, {"scenario": "left_turn"})
    return str(tmp_path)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("condition", ["noise", "variant"])
def test_the_results_are_those_of_one_process(policy, condition):
    env = make_environment("left_turn", condition)
    seeds = range(7, 14)
    alone = drive_episodes(env, load_driver(policy, env)[0], seeds, condition)
    seen: list[int] = []
    results = drive_episodes_in_parallel(
        policy, "left_turn", seeds, 2, condition, lambda result: seen.append(result.seed)
    )
    assert results == alone
    assert seen == list(seeds)


def test_a_worker_that_dies_is_said_in_one_line():
    def kill_one(result):
        worker, *_ = multiprocessing.active_children()
        worker.kill()

    with pytest.raises(UserError, match=r"a worker process died after \d+ of 5000 episodes"):
        drive_episodes_in_parallel("expert", "left_turn", range(5000), 2, on_episode=kill_one)
    assert not multiprocessing.active_children()


def test_a_policy_that_is_gone_when_a_worker_looks_is_named(tmp_path):
    gone = str(tmp_path / "gone")
    with pytest.raises(UserError, match="gone is no policy"):
        drive_episodes_in_parallel(gone, "left_turn", range(3), 1)


def workers_of(pid: int) -> list[int]:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(child) for child in children if is_worker(int(child))]


def is_worker(pid: int) -> bool:
    try:
        return b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def wait_until(condition, limit_s: float = 150.0) -> None:
    end_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.05)


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="looks for children in /proc")
@pytest.mark.parametrize(("sent", "status"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_whatever_ends_the_command_ends_its_workers(sent, status):
    command = ["evaluate", "expert", "--runs", "100000", "--jobs", "2"]
    process = subprocess.Popen(
        [sys.executable, "-m", "trainer", *command],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        wait_until(lambda: len(workers_of(process.pid)) == 2)
        workers = workers_of(process.pid)
        # To all of them, as a terminal does; while the workers start is the worst moment.
        os.killpg(process.pid, sent) if sent == signal.SIGINT else process.kill()
        _, err = process.communicate(timeout=150)
        assert process.returncode == status
        if sent == signal.SIGINT:
            assert err == "interrupted\n"
        wait_until(lambda: not any(is_worker(worker) for worker in workers))
    finally:
        process.kill()


def test_processes_are_started_only_where_they_pay():
    cores = parallel_cores()
    assert choose_jobs(WORTH_STARTING - 1) == 1
    assert choose_jobs(10 * WORTH_STARTING) == min(cores, 10 * WORTH_STARTING)


def test_the_command_reports_the_same_whatever_the_jobs(policy, tmp_path, capsys):
    reports = []
    for jobs in (1, 2):
        out = tmp_path / f"{jobs}.json"
        arguments = ["evaluate", policy, "--runs", "3", "--jobs", str(jobs), "--out", str(out)]
        assert main(arguments) == 0
        reports.append(out.read_bytes())
    assert reports[0] == reports[1]
