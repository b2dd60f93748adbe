"""The commands of a tutorial, run in an empty folder as its reader would type them.

Blocks of `bash`, and the lines after `$` of a `console`, are run in order in one shell that the
first failure ends; a block with a file's name behind its language is that file. Others (`sh`, ...)
are only read. What `pip install` brings goes into a folder that is thrown away, without an index.
"""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_BLOCK = re.compile(r"^```(\w+)(?: +(\S+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def script_of(text: str, folder: Path) -> str:
    """The commands of a page; its files are written into the folder."""
    commands = []
    for language, name, block in _BLOCK.findall(text):
        if name:
            (folder / name).write_text(block)
        elif language == "bash":
            commands.append(block)
        elif language == "console":
            commands += re.findall(r"^\$ ((?:.*\\\n)*.*\n)", block, re.MULTILINE)
    return "".join(commands)


@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "name",
    [
        "own_vehicle",
        # They train, which takes minutes of a processor together.
        *(
            pytest.param(name, marks=pytest.mark.board)
            for name in ("own_environment", "own_policy", "my_camera")
        ),
    ],
)
def test_every_command_of_a_tutorial_works(name, tmp_path):
    packages, folder = tmp_path / "packages", tmp_path / "empty"
    folder.mkdir()
    script = script_of((ROOT / f"docs/{name}.md").read_text(), folder)
    assert "python -m" in script
    environment = {
        **os.environ, "PHIL": str(ROOT), "PIP_TARGET": str(packages), "PIP_NO_DEPS": "1",
        "PIP_NO_BUILD_ISOLATION": "0", "PIP_NO_INDEX": "1",  # 0: without, as pip has it
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "PYTHONPATH": f"{packages}:{ROOT}:{os.environ.get('PYTHONPATH', '')}",
    }  # fmt: skip
    words = ["bash", "-xeuo", "pipefail", "-c", script]
    with (tmp_path / "said").open("w+") as said:
        shell = subprocess.Popen(
            words, cwd=folder, env=environment, stdout=said, stderr=said, start_new_session=True
        )
        try:
            status = shell.wait(800)
        finally:
            os.killpg(shell.pid, signal.SIGKILL)  # what it has left in the background, too
        said.seek(0)
        assert status == 0, said.read()[-4000:]
