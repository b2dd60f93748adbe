import pytest

from edge_runtime.util import UserError
from hil_tests.processes import Process, wait_until

SERVER = ("http.server", "0", "--bind", "127.0.0.1")


def test_a_process_has_crashed_where_nobody_ended_it():
    with Process("json.tool", "nowhere") as failed, Process(*SERVER) as ended:
        wait_until(lambda: failed.has_ended, "its end")
        ended.end()
        assert (failed.crashed(), ended.crashed()) == (True, False)


def test_a_process_that_ends_before_it_is_ready_says_why(tmp_path):
    with pytest.raises(UserError, match="does not exist"):
        Process("edge_runtime", "run", "--policy", str(tmp_path / "none.onnx"), ready="ready")
