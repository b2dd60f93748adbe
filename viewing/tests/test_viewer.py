"""rerun's viewer as a process: where it listens, when its address is told, and its end."""

import re
import time

import pytest
import rerun as rr
import rerun.blueprint as rrb

from edge_runtime.util import UserError
from viewing import sinks
from viewing.sinks import Sink, open_sink
from viewing.tests.viewers import NO_GPU, in_place, listens
from viewing.viewer import flush, free_port


def show(kind, for_s=0.0):
    with open_sink(Sink(kind), "test", rrb.Blueprint()) as recording:
        end_s = time.monotonic() + for_s
        while not for_s or time.monotonic() < end_s:
            recording.log("speed", rr.Scalars(3.0))
            flush(recording)
            if not for_s:
                break
        return recording


@pytest.mark.parametrize("kind", ["starts slowly", "works"])
def test_a_page_is_told_of_when_it_answers(kind, tmp_path, monkeypatch, capsys):
    with (
        in_place(kind, tmp_path, monkeypatch),
        open_sink(Sink("serve"), "test", rrb.Blueprint()) as recording,
    ):
        (address,) = re.findall(r"http://([\d.]+):(\d+)/", capsys.readouterr().out)
        assert listens(*address)
        assert listens("127.0.0.1", sinks.GRPC_PORT)
        assert not listens("127.0.0.2", sinks.GRPC_PORT), "loopback's first address only"
        recording.log("speed", rr.Scalars(3.0))
    end_s = time.monotonic() + 5.0
    while listens(*address):
        assert time.monotonic() < end_s, "it ends with the command"


def test_a_window_listens_on_loopback_only_and_stays_open(tmp_path, monkeypatch):
    ports = []

    def remembered():
        ports.append(free_port())
        return ports[-1]

    monkeypatch.setattr(sinks, "free_port", remembered)
    with in_place("works", tmp_path, monkeypatch):
        show("spawn")
        show("spawn")
        assert len(set(ports)) == 2, "each its own"
        assert [listens("127.0.0.1", port) for port in ports] == [True, True]
        assert [listens("127.0.0.2", port) for port in ports] == [False, False]


@pytest.mark.parametrize("where", ["spawn", "serve"])
@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("ends at once", NO_GPU),
        ("never listens", "does not listen after 1 s"),
        ("is killed", "it was closed"),
        ("hangs", "timed out"),
    ],
)
def test_a_viewer_that_is_gone_is_one_plain_error(where, kind, why, tmp_path, monkeypatch):
    with (
        in_place(kind, tmp_path, monkeypatch),
        pytest.raises(UserError, match=f"viewer gone: .*{why}"),
    ):
        show(where, for_s=5.0)
