"""Bad input is one line and exit status 2 for every command, and nothing is written."""

import shlex

import pytest

from bridge.ports import open_port
from edge_runtime.reach import free_endpoint
from hil_tests.testing.drives import LEFT_TURN, TOY

ROWS = [
    ("simulate --env phil/Nowhere-v0", "Nowhere"),
    ("simulate --env no_such_module:X-v0", "no_such_module"),
    ("simulate --env CartPole-v1", "acts in Discrete(2); the wire carries a Box with bounds"),
    ("simulate --env FrozenLake-v1", "observes Discrete(16); the wire carries Box or a flat Dict"),
    ("simulate --env Pendulum-v1 --wait-edge-s 0", "no edge runtime after 0 s"),
    ("simulate --env somebody/Creep-v0", "a gymnasium id"),
    ("simulate --env bridge.tests.broken_module:X-v0", "RuntimeError: two"),
    ("simulate --env TOY --condition variant", "scene"),
    ("simulate --env congestion --condition foggy", "foggy"),
    ("simulate --env ::", "module:id"),
    ("simulate --env TOY --latency fast", "latency"),
    ("simulate --env TOY --episodes 0", "at least 1"),
    ("simulate --env TOY --vehicle-id a/b", "vehicle id"),
    ("simulate --env TOY --listen here", "endpoint"),
    ("simulate --env TOY --connect here", "endpoint"),
    ("simulate --env TOY --connect FREE --wait-edge-s 0", "nobody answers"),
    ("simulate --env TOY --listen FREE --wait-edge-s 0", "python -m edge_runtime run"),
    ("simulate --env TOY --listen BUSY --out r.json", "in use"),
    ("simulate --env TOY --connect FREE --listen FREE", "not allowed"),
    ("simulate --env TOY --out /dev/null/r.json", "Not a directory"),
    ("simulate --env TOY --clock sundial", "sundial"),
    ("simulate --env TOY --loop vehicle", "--loop vehicle needs --clock realtime"),
    ("router --listen FREE --config router.json5", "goes with no other option"),
    ("record --out there.mcap", "exists"),
    ("record --out /dev/null/a.mcap", "Not a directory"),
    ("record --out a.mcap --vehicle-id a/b", "vehicle id"),
    ("record --out a.mcap --connect here", "endpoint"),
    ("record --out a.mcap --connect FREE --wait-s 0", "nobody"),
    ("replay LEFT_TURN --policy none.onnx", "does not exist"),
    ("replay LEFT_TURN", "--policy"),
    ("replay LEFT_TURN --policy a.onnx --tolerance -1", "tolerance"),
    ("replay LEFT_TURN --policy a.onnx --out /dev/null/r.json", "Not a directory"),
    ("replay missing.mcap --policy p.onnx", "No such file"),
    ("replay there.mcap --policy p.onnx", "no MCAP recording"),
    ("view --connect FREE --save never.rrd --wait-s 0", "nobody answers"),
    ("view --connect BUSY --save never.rrd --wait-s 0.2", "--vehicle-id"),
    ("view --connect FREE", "no display"),
    ("view --save /dev/null/a.rrd", "Not a directory"),
    ("view --connect FREE --save a.rrd --vehicle-id a/b", "vehicle id"),
    ("view --save a.rrd --serve", "not allowed with"),
    ("view --save a.mcap", "FILE.rrd"),
    ("view none.mcap --save a.rrd", "cannot be read"),
    ("view LEFT_TURN --vehicle-id other --save a.rrd", "holds no vehicle other"),
]


@pytest.fixture
def busy():
    """Where a simulator of another vehicle listens."""
    endpoint = free_endpoint()
    with open_port(endpoint, "other"):
        yield endpoint


@pytest.mark.parametrize(("command", "part"), ROWS)
def test_bad_input_is_one_line_and_status_2(command, part, refusal, busy, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    (tmp_path / "there.mcap").write_bytes(b"mine")
    words = {"TOY": TOY, "BUSY": busy, "LEFT_TURN": str(LEFT_TURN)}
    found = (free_endpoint() if w == "FREE" else words.get(w, w) for w in shlex.split(command))
    assert part in refusal(*found)
    assert [path.name for path in tmp_path.iterdir()] == ["there.mcap"]
    assert (tmp_path / "there.mcap").read_bytes() == b"mine"
