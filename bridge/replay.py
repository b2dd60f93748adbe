"""``python -m bridge replay``: recorded states through another policy or runtime, compared."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from bridge.arguments import add_tls, add_wait_edge
from bridge.port import open_port
from bridge.progress import count_bar
from bridge.replaying.comparison import compare
from bridge.replaying.in_process import Answers, replay_in_process
from bridge.replaying.live import replay_live
from bridge.replaying.recorded import RecordedDrive, key_of
from edge_runtime.cli import ArgumentParser, add_public_key, examples, not_negative_number
from edge_runtime.config import load_config
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.policy import load_policy
from edge_runtime.tls import tls_for
from edge_runtime.transport import check_endpoint
from edge_runtime.util import UserError, printable
from edge_runtime.wire import check_vehicle_id

DEFAULT_TOLERANCE = 1e-5
"""Two processors round differently; a graph of the same weights stays far below this."""
DIFFERENT = 1
"""Exit status where at least one command differs."""

EXAMPLE = examples(
    "python -m bridge replay hil_tests/recordings/left_turn.mcap \\\n"
    "    --policy results/policies/left_turn.onnx --public-key results/policies/policy.pub",
    "python -m bridge replay drive.mcap --listen tcp/127.0.0.1:7447 --out replay.json",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("recording", metavar="F.mcap", help="what bridge record has written")
    through = parser.add_mutually_exclusive_group(required=True)
    through.add_argument(
        "--policy", metavar="POLICY.onnx", help="replay in process, with the recording's times"
    )
    through.add_argument(
        "--listen",
        metavar="PROTOCOL/HOST:PORT",
        help="replay in real time to an edge runtime that connects here",
    )
    through.add_argument(
        "--connect",
        metavar="PROTOCOL/HOST:PORT",
        help="replay in real time to an edge runtime behind this router",
    )
    add_tls(parser)
    add_public_key(parser)
    parser.add_argument(
        "--allow-unsigned",
        action="store_true",
        help="also take a policy whose origin cannot be verified",
    )
    parser.add_argument(
        "--config",
        metavar="FILE.toml",
        help="with --policy: the settings of the edge runtime that was recorded, where a vehicle's"
        " model or scale was not the default",
    )
    parser.add_argument(
        "--vehicle-id", metavar="ID", help="which vehicle, where the recording holds several"
    )
    parser.add_argument(
        "--tolerance",
        metavar="X",
        type=not_negative_number,
        default=DEFAULT_TOLERANCE,
        help="how far two actions may be apart, of a range of -1 to 1",
    )
    add_wait_edge(parser)
    parser.add_argument("--out", metavar="R.json", help="write the report to this file")


def run(arguments: Any) -> int:
    """Run the command: 0 where every command is the same, 1 where one differs."""
    if arguments.out is not None:
        check_writable(arguments.out)
    if arguments.vehicle_id is not None:
        check_vehicle_id(arguments.vehicle_id)
    drive = RecordedDrive(Path(arguments.recording), arguments.vehicle_id)
    policy_id, replayed = _answers(drive, arguments)
    states = [key_of(state) for state in drive.states()]
    report = {
        "recording": str(arguments.recording),
        "vehicle_id": drive.vehicle_id,
        "policy_id": policy_id,
        "recorded_policy_ids": drive.policy_ids,
        "cut_off": drive.recording.cut_off,
        "damaged_places": drive.recording.damaged_places,
        "damaged_bytes": drive.recording.damaged_bytes,
        "dropped": _dropped(drive),
        **compare(drive.exchanges, replayed, states, arguments.tolerance),
    }
    if report["compared"] == 0:
        raise UserError(f"{arguments.recording} holds answers, but none of the states they answer")
    write_json_out(arguments.out, report)
    if drive.recording.trouble():
        print(
            f"the recording {drive.recording.trouble()}; what is whole of it was replayed",
            file=sys.stderr,
        )
    _say(report)
    return DIFFERENT if report["different"] else 0


def _dropped(drive: RecordedDrive) -> int:
    """Messages that the recorder had to drop; of another program's recording nothing is known."""
    dropped = drive.recording.metadata.get("dropped", "")
    return int(dropped) if dropped.isdecimal() else 0


def _answers(drive: RecordedDrive, arguments: Any) -> tuple[str, Answers]:
    if arguments.policy is not None:
        if arguments.tls is not None:
            raise UserError("--tls is for a link, of --listen or --connect; --policy has none")
        policy = load_policy(arguments.policy, arguments.public_key, arguments.allow_unsigned)
        config = load_config(arguments.config, {"policy": arguments.policy})
        return policy.policy_id, replay_in_process(drive, policy, config)
    if arguments.config is not None:
        raise UserError("--config is for --policy; an edge runtime that is asked has its own")
    endpoint = check_endpoint(arguments.listen or arguments.connect)
    wait_s, tls = arguments.wait_edge_s, tls_for(arguments.tls, endpoint)
    with open_port(arguments.listen, drive.vehicle_id, tls, arguments.connect, wait_s) as port:
        port.wait_for_edge(wait_s, endpoint)
        with count_bar("states", len(drive.exchanges)) as bar:
            answers = replay_live(drive, port, bar)
        return port.edge_policy_id(), answers


def _say(report: dict[str, Any]) -> None:
    print(
        f"{report['compared']} commands compared, {report['different']} differ; largest difference"
        f" {report['largest_difference']:.3g}, tolerance {report['tolerance']:g};"
        f" {report['unanswered']} states were never answered"
    )
    for row in report["first_differences"][:3]:
        print(f"  episode {row['episode']} step {row['step']}: {_told(row)}")


def _told(row: dict[str, Any]) -> str:
    def text(answers: list[dict[str, Any]]) -> str:
        parts = [
            f"{answer['mode']} {[round(value, 4) for value in answer['action']]}"
            + (f" ({printable(answer['reason'])})" if answer["reason"] else "")
            for answer in answers
        ]
        return ", then ".join(parts) or "nothing"

    return f"recorded {text(row['recorded'])}; replayed {text(row['replayed'])}"
