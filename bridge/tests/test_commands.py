"""Bad input is one line and exit status 2 for every command, and nothing is written."""

import shlex

import pytest

from bridge.ports import open_port
from edge_runtime.reach import free_endpoint
from hil_tests.processes import POLICY, PUBLIC_KEY
from hil_tests.tests.shared.drives import LEFT_TURN, TOY

OURS = f"{POLICY.absolute()} --public-key {PUBLIC_KEY.absolute()}"
ROWS = [
    ("simulate --env phil/Nowhere-v0", "Nowhere"),
    ("simulate --env CartPole-v1", "acts in Discrete(2); the wire carries a Box with bounds"),
    ("simulate --env FrozenLake-v1", "observes Discrete(16); the wire carries Box or a flat Dict"),
    ("simulate --env bridge.tests.broken_module:X-v0", "RuntimeError: two"),
    ("simulate --env TOY --condition variant", "scene"),
    ("simulate --env ::", "module:id"),
    ("simulate --env TOY --vehicle-id a/b", "vehicle id"),
    ("simulate --env TOY --connect here", "endpoint"),
    ("simulate --env TOY --connect FREE --wait-edge-s 0", "no link"),
    ("simulate --env TOY --listen FREE --wait-edge-s 0", "python -m edge_runtime run"),
    ("simulate --env TOY --listen BUSY --out r.json", "in use"),
    ("simulate --env TOY --out /dev/null/r.json", "Not a directory"),
    ("simulate --env TOY --loop vehicle", "--loop vehicle needs --clock realtime"),
    ("record --out there.mcap", "exists"),
    ("record --out a.mcap --connect FREE --wait-s 0", "no link"),
    ("replay LEFT_TURN --policy none.onnx", "does not exist"),
    ("replay missing.mcap --policy p.onnx", "No such file"),
    ("replay there.mcap --policy p.onnx", "no MCAP recording"),
    ("shadow --policy none.onnx --from LEFT_TURN", "does not exist"),
    ("shadow --policy OURS --from missing.mcap", "No such file"),
    ("shadow --policy OURS --from LEFT_TURN --record there.mcap", "exists"),
    ("shadow --policy OURS --from LEFT_TURN --port 7000", "--serve"),
    ("shadow --policy OURS --from LEFT_TURN --foxglove", "F.mcap"),
    ("shadow --policy OURS --from LEFT_TURN --config none.toml", "does not exist"),
    ("shadow --policy OURS --connect FREE --wait-s 0", "no link"),
    ("view --connect BUSY --save never.rrd --wait-s 0.2", "--vehicle-id"),
    ("view --connect FREE", "no display"),
    ("view --save /dev/null/a.rrd", "Not a directory"),
    ("view none.mcap --save a.rrd", "cannot be read"),
    ("view LEFT_TURN --vehicle-id other --save a.rrd", "holds vehicles hunter01; name one"),
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
    found = shlex.split(command.replace("OURS", OURS))
    assert part in refusal(*(free_endpoint() if w == "FREE" else words.get(w, w) for w in found))
    assert [path.name for path in tmp_path.iterdir()] == ["there.mcap"]
    assert (tmp_path / "there.mcap").read_bytes() == b"mine"
