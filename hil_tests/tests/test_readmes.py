"""What the READMEs point at is there."""

import re
from pathlib import Path

import pytest

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
