"""The injected network as netem's arguments, for kernels that have it. Pure but for the probe.

Not everything has a counterpart: outages, a kept order and the lognormal tail are netem's not.
"""

from __future__ import annotations

import subprocess

from bridge.network import DirectionSpec, bad_share
from edge_runtime.util import UserError
from hil_tests.network.namespaces import inside

_PROBE = ("tc", "qdisc", "add", "dev", "lo", "root", "netem", "delay", "1ms")


def has_netem(namespace: str) -> bool:
    """Whether the kernel takes a netem qdisc."""
    if subprocess.run((*inside(namespace), *_PROBE), check=False, capture_output=True).returncode:
        return False
    undo = (*inside(namespace), "tc", "qdisc", "delete", "dev", "lo", "root")
    subprocess.run(undo, check=True, capture_output=True)
    return True


def netem_arguments(spec: DirectionSpec) -> list[str]:
    """What stands after ``tc qdisc add dev DEVICE root netem``.

    Raises:
        UserError: the specification has something that netem has not.
    """
    missing = {
        "outage": bool(spec.outages),
        "order=kept": spec.order == "kept",
        "tail=lognormal": spec.tail == "lognormal",
        # netem reorders by sending at once, which overtakes nothing at a period of 100 ms.
        "reorder": spec.reorder_percent > 0,
    }
    if any(missing.values()):
        names = ", ".join(name for name, there in missing.items() if there)
        raise UserError(f"netem has no {names}; leave it out")
    words = ["delay", f"{spec.delay_ms:g}ms", f"{spec.jitter_ms:g}ms"]
    if spec.jitter_ms:
        words += ["distribution", spec.tail]
    return words + _loss(spec) + _duplicates(spec) + _rate(spec)


def _loss(spec: DirectionSpec) -> list[str]:
    if not spec.burst_messages:
        return ["loss", "random", f"{spec.loss_percent:g}%"] if spec.loss_percent else []
    share, to_good = bad_share(spec), 1.0 / spec.burst_messages
    to_bad = to_good * share / (1.0 - share)
    percents = (100 * to_bad, 100 * to_good, spec.burst_loss_percent, spec.clear_loss_percent)
    return ["loss", "gemodel", *(f"{percent:g}%" for percent in percents)]


def _duplicates(spec: DirectionSpec) -> list[str]:
    return ["duplicate", f"{spec.duplicate_percent:g}%"] if spec.duplicate_percent else []


def _rate(spec: DirectionSpec) -> list[str]:
    if not spec.rate_kbps:
        return []
    # Packets of 1,500 bytes that fit into the wait that the queue stands for.
    limit = max(1, round(spec.rate_kbps * spec.queue_ms / 8 / 1500))
    return ["rate", f"{spec.rate_kbps:g}kbit", "limit", str(limit)]
