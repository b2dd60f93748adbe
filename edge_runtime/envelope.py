"""The envelope of a policy: the networks in which it was shown to succeed. Contract, section 4.

`hil_tests envelope` measures it, `--envelope` puts it into the manifest, under the signature, and
link_quality.py holds the live link against it.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec

from edge_runtime.manifest import Task
from edge_runtime.util import UserError

ENVELOPE_SCHEMA = 1


class LinkLimits(msgspec.Struct, frozen=True, kw_only=True):
    """How much of each alone the policy bears, each way: mean delay, standard deviation, share of
    messages lost one by one, mean run of lost messages, length of outages.
    """

    delay_ms: float
    jitter_ms: float
    loss_percent: float
    burst_messages: float
    outage_s: float


class LinkEnvelope(msgspec.Struct, frozen=True, kw_only=True):
    """The networks in which the policy succeeds with `promised_success`, as it was measured.

    A network is inside where every value / limit is at most 1 and their sum at most `joint`, and
    where every value / limit is at most `box`. `policy_id` names the file that was measured, before
    the envelope was in it; `network` is the SHA-256 of its graph, which stays the same.
    """

    policy_id: str
    env: str
    condition: str
    promised_success: float
    confidence: float
    control_period_s: float
    limits: LinkLimits
    joint: float
    box: float = 0.0
    network: str = ""
    schema: int = ENVELOPE_SCHEMA


def read_envelope(value: Any, task: Task) -> LinkEnvelope:
    """The envelope in a JSON value. Raises UserError where it is none, or none of this task's."""
    try:
        envelope = msgspec.convert(value, LinkEnvelope)
    except msgspec.ValidationError as error:
        raise UserError(f"the envelope is not valid: {error}") from None
    limits = [getattr(envelope.limits, name) for name in envelope.limits.__struct_fields__]
    if envelope.schema != ENVELOPE_SCHEMA:
        raise UserError(f"the envelope has schema {envelope.schema}, not {ENVELOPE_SCHEMA}")
    finite = all(0.0 <= value < math.inf for value in (*limits, envelope.joint, envelope.box))
    if not (finite and envelope.joint):
        raise UserError("the envelope's limits must be 0 or more, its joint above 0, all finite")
    if envelope.control_period_s != task.control_period_s:
        found = f"the envelope was measured every {envelope.control_period_s:g} s"
        raise UserError(f"{found}, the policy drives every {task.control_period_s:g} s")
    return envelope
