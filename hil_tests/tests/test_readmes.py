"""What the READMEs point at is there."""

import os
import re
import subprocess
from pathlib import Path

import pytest

from deploy.wheels import TARGETS
from edge_runtime.ros2.endpoint import DEFAULT_ROS2_ENDPOINT

ROOT = Path(__file__).parents[2]
READMES = sorted(
    path.relative_to(ROOT)
    for path in [*ROOT.glob("*.md"), *ROOT.glob("*/README.md")]
    if ".venv" not in path.parts
)


def test_every_folder_has_one():
    folders = ("edge_runtime", "viewing", "bridge", "trainer", "hil_tests", "deploy")
    assert {Path(folder) / "README.md" for folder in folders} <= set(READMES)


@pytest.mark.parametrize("readme", READMES, ids=str)
def test_links_and_kept_files_exist_and_nothing_is_left_to_fill_in(readme):
    text = (ROOT / readme).read_text()
    links = re.findall(r"\]\(([^)#:]+)\)", text)
    kept = re.findall(r"\bresults/[\w./-]+\.(?:onnx|pub|json|csv|md)\b", text)
    for link in links:
        assert (ROOT / readme.parent / link).exists(), link
    for path in kept:
        assert (ROOT / path).exists(), path
    assert "<!--" not in text


def test_security_names_every_port_that_speaks_plain_text_beside_tls():
    text = (ROOT / "SECURITY.md").read_text()
    assert f"`{DEFAULT_ROS2_ENDPOINT}`" in text
    assert "--vehicle ros2" in text


@pytest.mark.parametrize("readme", ["README.md", "deploy/README.md"])
def test_of_two_bundles_the_newest_one_is_pushed(readme, tmp_path):
    """The command as it stands there, in a shell, with a program that tells its arguments."""
    (command,) = re.findall(
        r"^python -m deploy push (?:.*\\\n)*.*$", (ROOT / readme).read_text(), re.M
    )
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\nfor each in "$@"; do echo "$each"; done\n')
    python.chmod(0o755)
    bundles = tmp_path / "build" / "bundles"
    bundles.mkdir(parents=True)
    for number, name in enumerate(("b", "a")):
        path = bundles / f"phil-jetpack5-hunter01-{name}.tar"
        path.touch()
        os.utime(path, (number, number))
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    told = subprocess.run(
        ["sh", "-c", command], cwd=tmp_path, env={"PATH": path}, capture_output=True, text=True,
        check=True,
    ).stdout.split()  # fmt: skip
    assert [word for word in told if word.endswith(".tar")] == [
        "build/bundles/phil-jetpack5-hunter01-a.tar"
    ]


def test_the_table_of_targets_is_that_of_the_bundles():
    text = (ROOT / "deploy" / "README.md").read_text()
    for target in TARGETS.values():
        assert f"| `{target.name}` | {target.python} | {target.machine}, {target.glibc} |" in text
    assert f"this bundle needs Python {TARGETS['jetpack5'].python} there" in (
        (ROOT / "README.md").read_text()
    )
