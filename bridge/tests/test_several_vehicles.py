"""Several simulators and edge runtimes on one router: each pair is as if it were alone."""

from __future__ import annotations

import contextlib

import numpy as np

from bridge.tests.processes import (
    TOY,
    BridgeProcess,
    drive_in_process,
    make_policy,
    read,
    start_edge,
)
from edge_runtime.link_probe import free_endpoint
from edge_runtime.transport import open_session

PAIRS = {"car-a": ("mean", 0.0, 40), "car-b": ("constant", 0.25, 60)}
"""Vehicle id -> kind and value of its policy, and its seed."""


def drive_all(folder, endpoint):
    """Drive every pair at once; return the reports by vehicle id."""
    runs = {}
    with contextlib.ExitStack() as stack:
        for vehicle_id, (kind, value, seed) in PAIRS.items():
            policy = make_policy(folder, kind, value)
            out = folder / f"{vehicle_id}.json"
            options = ("--connect", endpoint, "--vehicle-id", vehicle_id)
            arguments = ("simulate", "--env", TOY, "--seed", str(seed), "--out", str(out))
            run = stack.enter_context(BridgeProcess(*arguments, "--episodes", "2", *options))
            stack.enter_context(start_edge(endpoint, policy, "--vehicle-id", vehicle_id))
            runs[vehicle_id] = (run, policy, out)
        for run, _, _ in runs.values():
            assert run.wait() == 0, run.errors
    return {vehicle_id: (read(out), policy) for vehicle_id, (_, policy, out) in runs.items()}


def test_two_vehicles_on_one_router_each_drive_as_if_alone(tmp_path):
    endpoint = free_endpoint()
    router = open_session(listen=endpoint, mode="router")
    try:
        for _ in range(3):  # A busy machine may pause a process for over 2 T.
            reports = drive_all(tmp_path, endpoint)
            if not any(r["safe_stops"] or r["rejected"] for r, _ in reports.values()):
                break
    finally:
        router.close()
    assert len({report["policy_id"] for report, _ in reports.values()}) == 2
    for report, policy in reports.values():
        assert report["rejected"] == {}
        for row in report["per_episode"]:
            outcome, actions = drive_in_process(policy, row["seed"])
            assert row["outcome"] == outcome
            np.testing.assert_allclose(row["actions"], actions, atol=1e-5)
