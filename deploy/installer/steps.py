"""Install, upgrade, roll back, uninstall: the order of things, so that no step can break a board.

A release becomes `current` only when its files are whole, its policy may drive and it has passed
its trial; `current` changes by one rename. Cut off at any moment, the board has the old release or
the new one, and the same command again completes the work.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from deploy.installer.layout import (
    LAUNCHER,
    POLICY,
    PUBLIC_KEY,
    Layout,
    make_release,
    why_not_whole,
    write_whole,
)
from deploy.installer.systemd import Limits, NoService, remember
from deploy.installer.verify import (
    MANIFEST,
    Bundle,
    UnhealthyError,
    UserError,
    check_fits,
    parse_manifest,
    read_bundle,
    read_public_key,
    same_key,
)

_CHECK_LIMIT_S = 120.0
_ENDS_A_SWITCH = (UnhealthyError, UserError, OSError, KeyboardInterrupt)
"""The old service is stopped then, so whatever goes wrong, somebody must start it again."""


class Way(NamedTuple):
    """How the service runs, and what is healthy."""

    service: NoService
    limits: Limits


def install(bundle_path: str, trust: str | None, layout: Layout, way: Way) -> str:
    """Install or upgrade; return the version. Nothing is written before the bundle is verified.

    Raises UserError where it may not be installed here, UnhealthyError where it was and went back.
    """
    key = trusted_key(layout, trust)
    bundle = read_bundle(bundle_path, key)
    version = bundle.manifest.version
    _say(f"verified {version} for {bundle.manifest.vehicle_id}")
    check_fits(bundle.manifest.target)
    with layout.locked():
        layout.tidy()
        if not layout.trusted.exists():
            write_whole(layout.trusted, key)
        remember(way.service.name, layout.root)
        _unpack(bundle, layout, way)
        activate(version, layout, way, is_new=True)
    return version


def rollback(layout: Layout, way: Way) -> str:
    """Go back to the release before; return its version."""
    with layout.locked():
        layout.tidy()
        version = layout.linked("previous")
        if version is None or version == layout.linked("current"):
            raise UserError(f"{layout.root} holds no earlier release to go back to")
        fault = why_not_whole(layout.release(version))
        if fault:
            raise UserError(f"release {version} is damaged: {fault}")
        activate(version, layout, way, is_new=False)
    return version


def activate(version: str, layout: Layout, way: Way, is_new: bool) -> None:
    """Prove a release, let the service run it, and go back by itself where it is not healthy."""
    folder, before = layout.release(version), layout.linked("current")
    try:
        _prove(folder, way)
    except UnhealthyError as error:
        if is_new and version not in (before, layout.linked("previous")):
            layout.remove_release(version)
        stays = f"{before} goes on" if before else "nothing is installed"
        raise UnhealthyError(f"release {version} may not run here, {stays}: {error}") from None
    _switch(version, before, layout, way)
    for other in layout.versions():
        if other not in (layout.linked("current"), layout.linked("previous")):
            layout.remove_release(other)


def uninstall(layout: Layout, way: Way) -> None:
    """Stop the service and remove all that was installed, the trusted key last."""
    if not layout.releases.is_dir() and not layout.trusted.exists():
        raise UserError(f"nothing is installed in {layout.root}")
    with layout.locked():
        way.service.remove()
        for name in ("current", "previous"):
            layout.unlink(name)
        layout.tidy()
        for path in (layout.releases, layout.state):
            shutil.rmtree(str(path), ignore_errors=True)
        if layout.trusted.exists():
            layout.trusted.unlink()
        (layout.root / ".lock").unlink()
    try:
        layout.root.rmdir()
    except OSError:
        _say(f"{layout.root} stays: it holds what is not ours")


def trusted_key(layout: Layout, trust: str | None) -> bytes:
    """The key that bundles must be signed with, in PEM: the board's own, or the first one named."""
    given = read_public_key(trust) if trust is not None else None
    if not layout.trusted.exists():
        if given is None:
            raise UserError("this board trusts no key yet: name your public key with --trust")
        return given
    kept = read_public_key(str(layout.trusted))
    if given is not None and not same_key(given, kept):
        raise UserError(
            f"this board trusts another key than {trust}; whoever owns the board may replace"
            f" {layout.trusted}"
        )
    return kept


def _unpack(bundle: Bundle, layout: Layout, way: Way) -> None:
    version = bundle.manifest.version
    if layout.release(version).is_dir():
        fault = why_not_whole(layout.release(version))
        if not fault:
            _say(f"{version} lies here already, whole")
            return
        _say(f"{version} lies here damaged ({fault}): made again")
        if layout.linked("current") == version:
            way.service.stop()
        layout.remove_release(version)
    folder = make_release(bundle, layout, way.service.group())
    _say(f"unpacked {folder}")


def _prove(folder: Path, way: Way) -> None:
    _check_policy(folder)
    _say("edge_runtime check: the policy may drive")
    if way.service.name != "none":
        policy_id = parse_manifest((folder / MANIFEST).read_bytes()).policy_id
        way.service.try_release(folder, policy_id, way.limits)
        _say("trial: healthy, in a network of its own")


def _check_policy(folder: Path) -> None:
    """`edge_runtime check` by the release's own runtime. UnhealthyError with its last line."""
    command = [str(folder / LAUNCHER), "check", POLICY, "--public-key", PUBLIC_KEY]
    try:
        done = subprocess.run(
            command, cwd=str(folder), timeout=_CHECK_LIMIT_S, check=False,
            capture_output=True, text=True,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise UnhealthyError(f"edge_runtime check took over {_CHECK_LIMIT_S:.0f} s") from None
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
        raise UnhealthyError(f"edge_runtime check: {lines[-1]}")


def _switch(version: str, before: str | None, layout: Layout, way: Way) -> None:
    earlier = layout.linked("previous")
    try:
        way.service.stop()
        if before is not None and before != version:
            layout.link("previous", before)
        layout.link("current", version)
        _start(version, layout, way)
    except _ENDS_A_SWITCH as error:
        why = str(error) or "interrupted"
        _say(f"{version} is not healthy: {why}")
        # Cut off between the rename and here, `current` is this very release already.
        good = before if before != version else earlier
        _go_back(version, good, earlier, layout, way)
        raise UnhealthyError(
            f"release {version} was not healthy as a service,"
            f" {f'went back to {good}' if good else 'nothing is installed'}: {why}"
        ) from None


def _start(version: str, layout: Layout, way: Way) -> None:
    """Let the service run; the vehicle hears nothing of it until it is healthy."""
    if way.service.name == "none":
        return  # Whoever runs it could not be watched, and might not be allowed to read the hold.
    with layout.holding(way.service.group()):
        try:
            way.service.start(layout.release(version))
            way.service.watch(way.limits)
        except BaseException:  # while the hold lasts, so that nothing unproven is ever heard
            way.service.stop()
            raise


def _go_back(version: str, good: str | None, earlier: str | None, layout: Layout, way: Way) -> None:
    if good is None:
        way.service.remove()
        layout.unlink("current")
        layout.remove_release(version)
        return
    way.service.stop()
    layout.link("current", good)
    if earlier is not None and earlier != good:
        layout.link("previous", earlier)
    else:
        layout.unlink("previous")
    if (
        version != earlier
    ):  # A release that has served before stays, for a roll-back at another time.
        layout.remove_release(version)
    try:
        _start(good, layout, way)
    except UnhealthyError as error:
        raise UnhealthyError(f"{version} was not healthy, nor is {good} again: {error}") from None


def _say(text: str) -> None:
    try:
        print(text, flush=True)
    except OSError:
        # A reader that is gone, as an ssh link that broke, must not keep us from going back. What
        # is left of the line would fail again at the next flush.
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
