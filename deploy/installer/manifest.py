"""The signed list of what a bundle holds, and for which board and vehicle it is.

It is read only after its signature holds, so a fault in it is ours: one line, and no install.
"""

from __future__ import annotations

import json
import re
from typing import Any, NamedTuple

from deploy.installer.errors import UserError

FORMAT = 1
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._+-]*(/[A-Za-z0-9_][A-Za-z0-9._+-]*)*")
_VERSION = re.compile(r"[A-Za-z0-9][A-Za-z0-9.+-]{0,99}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


class FileEntry(NamedTuple):
    """One file of the bundle; `size` in bytes, `sha256` in hex."""

    path: str
    size: int
    sha256: str


class Target(NamedTuple):
    """A kind of board: `python` like 3.8, `machine` as uname says, the least `glibc`."""

    name: str
    python: str
    machine: str
    glibc: str


class Manifest(NamedTuple):
    """All of it. `version` names these bytes and no others."""

    version: str
    target: Target
    vehicle_id: str
    policy_id: str
    files: list[FileEntry]


def to_json(manifest: Manifest) -> bytes:
    """The one way to write it: sorted keys, no spaces, a newline at the end."""
    value: dict[str, Any] = manifest._asdict()
    value["format"] = FORMAT
    value["target"] = manifest.target._asdict()
    value["files"] = [entry._asdict() for entry in manifest.files]
    return json.dumps(value, sort_keys=True, separators=(",", ":")).encode() + b"\n"


def parse_manifest(data: bytes) -> Manifest:
    """Read `to_json`. Raises UserError for another format, and for names that leave the release."""
    try:
        value = json.loads(data)
        if value["format"] != FORMAT:
            raise UserError(f"its format is {value['format']}, this installer reads {FORMAT}")
        manifest = Manifest(
            version=value["version"],
            target=Target(**value["target"]),
            vehicle_id=value["vehicle_id"],
            policy_id=value["policy_id"],
            files=[FileEntry(**entry) for entry in value["files"]],
        )
        _check(manifest)
    except (ValueError, TypeError, KeyError, RecursionError):
        raise UserError("its manifest is not valid") from None
    return manifest


def _check(manifest: Manifest) -> None:
    if not _VERSION.fullmatch(manifest.version):
        raise ValueError(manifest.version)
    for entry in manifest.files:
        if not (_NAME.fullmatch(entry.path) and _SHA256.fullmatch(entry.sha256)):
            raise ValueError(entry.path)
        if isinstance(entry.size, bool) or entry.size < 0:
            raise ValueError(entry.path)
    if len({entry.path for entry in manifest.files}) != len(manifest.files):
        raise ValueError("a file stands there twice")
