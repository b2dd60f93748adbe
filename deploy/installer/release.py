"""A release on the disk: made of a bundle, and known to be whole later.

manifest.json manifest.sig install.pyz policy.* config.toml tls/ units/   as in the bundle
site-packages/    the wheels, unpacked and compiled
launch.py, bin/phil-edge    start the runtime with this Python and these packages alone
contents.json     the SHA-256 of every file, by which a release is known to be whole
"""

from __future__ import annotations

import compileall
import functools
import hashlib
import json
import multiprocessing
import os
import shlex
import shutil
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool, ProcessPoolExecutor
from pathlib import Path

from deploy.installer.apart import end_with_parent
from deploy.installer.archive import MANIFEST, SIGNATURE, Bundle
from deploy.installer.errors import UnhealthyError, UserError
from deploy.installer.layout import Layout, remove_tree, sync_all, sync_folder
from deploy.installer.wheels import unpack_wheel

SITE, CONTENTS, LAUNCHER = "site-packages", "contents.json", "bin/phil-edge"
WHEELS, TLS = "wheels/", "tls/"
POLICY, PUBLIC_KEY, CONFIG = "policy.onnx", "policy.pub", "config.toml"
_NOT_COMPILED = "tests"
"""numpy's own tests are a quarter of all files, and nobody imports them here."""
CHECK_LIMIT_S = 120.0
_LAUNCH = """\
import os
import runpy
import site
import sys

# The packages of this release and the standard library; nothing else of this computer (-I -S).
site.addsitedir(os.path.join(os.path.dirname(os.path.abspath(__file__)), "site-packages"))
sys.argv[0] = "phil-edge"
runpy.run_module("edge_runtime", run_name="__main__")
"""


def make_release(bundle: Bundle, layout: Layout, group: int | None) -> Path:
    """Unpack a bundle; the folder appears under its name when all of it is on the disk.

    `group` is the id of the group that may read the TLS key, None for the owner alone.
    """
    version = bundle.manifest.version
    folder, draft = layout.release(version), layout.making(version)
    remove_tree(draft)
    _check_room(bundle, layout)
    try:
        _fill(bundle, draft, folder, group)
        _write(draft / CONTENTS, json.dumps(hashes(draft), indent=0).encode())
        sync_all(draft)
        draft.rename(folder)
        sync_folder(layout.releases)
    except OSError as error:
        remove_tree(draft)
        raise UserError(f"cannot write {folder}: {error.strerror}") from None
    except UserError:
        remove_tree(draft)
        raise
    return folder


def why_not_whole(folder: Path) -> str:
    """What is missing or changed in a release; empty where every file is as it was made."""
    try:
        wanted = json.loads((folder / CONTENTS).read_bytes())
    except (OSError, ValueError):
        return f"{CONTENTS} cannot be read"
    found = hashes(folder)
    wrong = sorted(p for p in wanted.keys() | found.keys() if wanted.get(p) != found.get(p))
    return f"{len(wrong)} files are missing or changed, {wrong[0]} first" if wrong else ""


def hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a release but `contents.json`, by path."""
    found = {}
    for place, _, names in os.walk(str(folder)):
        for name in names:
            path = Path(place, name)
            relative = path.relative_to(folder).as_posix()
            if relative != CONTENTS:
                found[relative] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def check_policy(folder: Path) -> None:
    """`edge_runtime check` by the release's own runtime. UnhealthyError with its last line."""
    command = [str(folder / LAUNCHER), "check", POLICY, "--public-key", PUBLIC_KEY]
    try:
        done = subprocess.run(
            command, cwd=str(folder), timeout=CHECK_LIMIT_S, check=False,
            capture_output=True, text=True,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise UnhealthyError(f"edge_runtime check took over {CHECK_LIMIT_S:.0f} s") from None
    if done.returncode != 0:
        raise UnhealthyError(f"edge_runtime check: {last_line(done.stderr, done.returncode)}")


def last_line(text: str, status: int) -> str:
    """What a process said last, or how it ended."""
    lines = text.strip().splitlines()
    return lines[-1] if lines else f"exit status {status}"


def _fill(bundle: Bundle, draft: Path, folder: Path, group: int | None) -> None:
    draft.mkdir(mode=0o755)
    _write(draft / MANIFEST, bundle.manifest_json)
    _write(draft / SIGNATURE, bundle.signature)
    for entry in bundle.manifest.files:
        data = bundle.read(entry)
        if entry.path.startswith(WHEELS):
            unpack_wheel(data, entry.path, draft / SITE)
        else:
            secret = entry.path.startswith(TLS)
            _write(draft / entry.path, data, 0o640 if secret else 0o644, group if secret else None)
    _write(draft / "launch.py", _LAUNCH.encode())
    _write(draft / LAUNCHER, _launcher(folder).encode(), 0o755)
    _compile(draft / SITE)


def _compile(site: Path) -> None:
    """Now, because the service may not write here, and compiling at each start takes seconds."""
    sources = [str(p) for p in site.rglob("*.py") if _NOT_COMPILED not in p.relative_to(site).parts]
    # Forked, so that they are this thread's own children and end with it.
    pool = ProcessPoolExecutor(
        mp_context=multiprocessing.get_context("fork"),
        initializer=end_with_parent,
        initargs=(os.getpid(),),
    )
    try:
        with pool:
            list(pool.map(functools.partial(compileall.compile_file, quiet=2), sources))
    except BrokenProcessPool:
        raise UserError(
            "a process that compiled the release was killed; is there too little memory?"
        ) from None


def _launcher(folder: Path) -> str:
    parts: list[str] = [sys.executable, "-I", "-S", "-B", str(folder / "launch.py")]
    return "#!/bin/sh\nexec " + " ".join(map(shlex.quote, parts)) + ' "$@"\n'


def _write(path: Path, data: bytes, mode: int = 0o644, group: int | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o755)
    descriptor = os.open(str(path), os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with open(descriptor, "wb") as stream:
        stream.write(data)
    if group is not None:
        os.chown(str(path), -1, group)
    elif mode == 0o640:
        mode = 0o600
    os.chmod(str(path), mode)


def _check_room(bundle: Bundle, layout: Layout) -> None:
    """Unpacked and compiled, wheels take some four times their size."""
    needed = 5 * sum(entry.size for entry in bundle.manifest.files)
    free = shutil.disk_usage(str(layout.releases)).free
    if free < needed:
        raise UserError(
            f"not enough room in {layout.root}: {needed // 10**6} MB are needed,"
            f" {free // 10**6} MB are free"
        )
