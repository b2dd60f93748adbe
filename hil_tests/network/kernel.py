"""Two namespaces joined by a slow and lossy cable: netem where the kernel has it, else TUN."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator
from typing import NamedTuple

from bridge.network import DirectionSpec, LatencySpec
from edge_runtime.util import UserError
from hil_tests.commands import BackgroundCommand
from hil_tests.network.namespaces import Pair, inside, ip, namespaces, why_not
from hil_tests.network.netem import has_netem, netem_arguments
from hil_tests.network.tun_bridge import EDGE_ADDRESS, READY, SIMULATOR_ADDRESS

NETEM, TUN = "netem", "tun"
MTU = 1500


class Cable(NamedTuple):
    """How to reach both ends, and what the cable is made of."""

    simulator: tuple[str, ...]
    """Words before a command at the simulator's end; likewise the edge runtime's."""
    edge: tuple[str, ...]
    address: str
    kind: str


@contextlib.contextmanager
def kernel_network(
    spec: LatencySpec, seed: int, tag: str, mtu: int = MTU, kind: str | None = None
) -> Iterator[Cable]:
    """Join two new namespaces; they, the devices and the bridge are gone at the end.

    ``tag`` tells networks of one process apart; ``kind`` is NETEM, TUN, or None for netem where
    the kernel has it; ``mtu`` is the largest packet in bytes.

    Raises:
        UserError: this machine cannot, with the reason.
    """
    reason = why_not()
    if reason:
        raise UserError(f"no kernel network on this machine: {reason}")
    with namespaces(tag) as pair:
        kind = kind or (NETEM if has_netem(pair.simulator) else TUN)
        cable = Cable(inside(pair.simulator), inside(pair.edge), SIMULATOR_ADDRESS, kind)
        if kind == NETEM:
            _join_with_netem(pair, spec, mtu)
            yield cable
        else:
            with _tun_bridge(pair, spec, seed, mtu):
                yield cable


def _tun_bridge(pair: Pair, spec: LatencySpec, seed: int, mtu: int) -> BackgroundCommand:
    return BackgroundCommand(
        "hil_tests.network.tun_bridge", "--simulator", pair.simulator, "--edge", pair.edge,
        "--latency", str(spec), "--seed", str(seed), "--mtu", str(mtu), ready=READY,
    )  # fmt: skip


def _join_with_netem(pair: Pair, spec: LatencySpec, mtu: int) -> None:
    """A veth pair; each end delays what leaves it. It goes with its namespaces."""
    ends = ((pair.simulator, "up", SIMULATOR_ADDRESS), (pair.edge, "down", EDGE_ADDRESS))
    ip("-netns", pair.simulator, "link", "add", "up", "mtu", str(mtu), "type", "veth",
       "peer", "name", "down", "netns", pair.edge, "mtu", str(mtu))  # fmt: skip
    for namespace, device, address in ends:
        ip("-netns", namespace, "address", "add", f"{address}/24", "dev", device)
        ip("-netns", namespace, "link", "set", device, "up")
    for (namespace, device, _), direction in zip(ends, (spec.up, spec.down), strict=True):
        _shape(namespace, device, direction)


def _shape(namespace: str, device: str, direction: DirectionSpec) -> None:
    words = ["tc", "qdisc", "add", "dev", device, "root", "netem", *netem_arguments(direction)]
    subprocess.run([*inside(namespace), *words], check=True, capture_output=True)
