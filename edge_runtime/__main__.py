"""The command line: `python -m edge_runtime`, or `phil-edge` where the wheel is installed.

`run`, `sense` and `jog` are in files of these names, the other commands here.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
from functools import partial
from typing import Any, Dict, List

import msgspec

from edge_runtime.cli import command, program, run_cli
from edge_runtime.config import Config, add_flags, add_trust
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.link import ask, link_words
from edge_runtime.policy import infer, load_policy, probes
from edge_runtime.service import peak_memory_mb, quantiles_ms
from edge_runtime.tls import OPERATOR, check_name, common_name
from edge_runtime.transport import check_endpoint, tls_for
from edge_runtime.util import UserError, printable
from edge_runtime.watch import watch

_RUNS, _FEWEST_RUNS, _MOST_S = 300, 20, 10.0  # A slow policy gets fewer runs


def _check(arguments: argparse.Namespace) -> int:
    """Print the report as JSON. Raises UserError where the policy may not drive."""
    check_writable(arguments.out)
    policy = load_policy(arguments.policy, arguments.public_key, arguments.allow_unsigned)
    durations_ns: List[int] = []
    for observation in itertools.islice(itertools.cycle(probes(policy.layout)), _RUNS):
        durations_ns.append(infer(policy, observation)[1])
        if len(durations_ns) >= _FEWEST_RUNS and sum(durations_ns) > _MOST_S * 1e9:
            break
    inference_ms = quantiles_ms(durations_ns)
    limit_ms = policy.manifest.control_period_s * 1000
    if inference_ms["p99"] > limit_ms:
        took = f"its inference takes {inference_ms['p99']:.0f} ms (p99), over {limit_ms:.0f} ms"
        raise UserError(f"policy {arguments.policy} may not drive: {took}")
    import onnxruntime  # Here, because an operator's commands do without it.

    report = {
        "policy_id": policy.policy_id,
        "trust": policy.trust,
        "public_key": policy.public_key,
        "manifest": msgspec.to_builtins(policy.manifest),
        "inference_ms": inference_ms,
        "inference_runs": len(durations_ns),
        "memory_mb": peak_memory_mb(),
        "onnxruntime": onnxruntime.__version__,
    }
    print(json.dumps(report, indent=2))
    write_json_out(arguments.out, report)
    return 0


_TRUSTED = "my.onnx \\\n    --public-key keys/policy.pub"


@command(
    _check,
    f"python -m edge_runtime check {_TRUSTED}",
    "python -m edge_runtime check my.onnx --allow-unsigned --out check.json",
)
def check(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("policy", metavar="POLICY.onnx", help="policy file to check")
    parser.add_argument("--out", metavar="FILE.json", help="also write the report to this file")
    add_trust(parser)


def _add_operator(parser: argparse.ArgumentParser) -> None:
    add_flags(parser, "connect", "tls", "vehicle_id")
    parser.set_defaults(connect=Config().connect, vehicle_id=Config().vehicle_id)


def _status(arguments: argparse.Namespace) -> int:
    check_writable(arguments.out)
    tls = tls_for(arguments.tls, check_endpoint(arguments.connect))
    look = partial(ask, arguments.connect, arguments.vehicle_id, "status", tls)
    reply = look()
    if arguments.watch:
        watch(look, reply)
    print(render_status(reply))
    write_json_out(arguments.out, reply)
    return 0


@command(
    _status,
    "python -m edge_runtime status --connect tcp/10.0.0.2:7447 --vehicle-id hunter01",
    "python -m edge_runtime status --watch",
)
def status(parser: argparse.ArgumentParser) -> None:
    _add_operator(parser)
    add = parser.add_mutually_exclusive_group().add_argument
    add("--out", metavar="FILE.json", help="write the whole status to this file")
    text = "print a short status once a second until ^C"
    add("--watch", action="store_true", help=text)


def _rearm(arguments: argparse.Namespace) -> int:
    tls = tls_for(arguments.tls, check_endpoint(arguments.connect))
    if tls is not None:
        check_name(tls.name, common_name(OPERATOR, arguments.vehicle_id))
    answer = partial(ask, arguments.connect, arguments.vehicle_id, tls=tls)
    stop = "none seen"  # names the stop to re-arm: a delayed re-arm must not release a later one
    with contextlib.suppress(UserError):  # the next query reports why
        current = answer("status")
        newest = current["command"] or {}
        stop = f"{newest.get('session')}/{newest.get('episode')}/{current['safe_stops']}"
    reply = answer("rearm", payload=stop)
    if not reply["accepted"]:
        raise UserError(f"{arguments.vehicle_id} was not re-armed: {reply['detail']}")
    print(f"{arguments.vehicle_id} is re-armed; it drives once 5 states in a row were fresh")
    return 0


rearm = command(
    _rearm,
    "python -m edge_runtime rearm --connect tls/10.0.0.2:7447 \\\n"
    "    --tls certs/operator-hunter01 --vehicle-id hunter01",
)(_add_operator)

_NOT_SHOWN = ("manifest", "schema", "sent_ns", "command", "feedback")


def render_status(status: Dict[str, Any]) -> str:
    """Render a status reply, one line a field."""
    rows = {
        **{name: value for name, value in status.items() if name not in _NOT_SHOWN},
        "policy_id": f"{status['policy_id'][:12]} ({status['manifest']['task']})",
        "link": link_words(status.get("link", {})),
    }
    width = max(map(len, rows))
    return "\n".join(f"{name:<{width}}  {printable(_words(rows[name]))}" for name in rows)


def _words(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_words(each)}" for name, each in value.items()) or "none"
    return f"{value:.2f}" if isinstance(value, float) else str(value) or "none"


COMMANDS = {
    "check": (check, "check whether a policy may drive, and measure its inference time"),
    "run": ("edge_runtime.run", "drive a policy: answer each state of a simulator until ^C"),
    "sense": ("edge_runtime.sense", "send a source's observations in the simulator's place"),
    "jog": ("edge_runtime.jog", "try a vehicle step by step, its wheels up, before it drives"),
    "status": (status, "print the status of a running edge runtime"),
    "rearm": (rearm, "let a vehicle drive again after a safe stop"),
}
main = program(
    "python -m edge_runtime",
    "Drives a verified policy over Zenoh, and stops safely when in doubt.",
    COMMANDS,
    f"python -m edge_runtime check {_TRUSTED}",
    f"python -m edge_runtime run --policy {_TRUSTED}",
    "python -m edge_runtime status",
)


def script() -> None:
    status = run_cli(main)  # which has flushed stdout
    # The interpreter's exit would wait for a thread that hangs, or that a driver left behind.
    os._exit(status)


if __name__ == "__main__":
    script()
