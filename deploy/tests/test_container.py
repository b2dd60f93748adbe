"""The Dockerfile, read line by line (`make lint-container` lints it)."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCKERFILE = ROOT / "deploy" / "container" / "Dockerfile"


def instructions() -> list[tuple[str, str]]:
    """(INSTRUCTION, arguments), with continued lines joined and comments left out."""
    lines = [line for line in DOCKERFILE.read_text().splitlines() if not line.startswith("#")]
    joined = re.sub(r"\\\n\s*", " ", "\n".join(lines))
    return [
        (word, rest.strip()) for word, _, rest in (x.partition(" ") for x in joined.split("\n"))
    ]


def only(word: str) -> str:
    """The arguments of the last stage's only instruction of that name."""
    everything = instructions()
    begin = max(i for i, (each, _) in enumerate(everything) if each == "FROM")
    (found,) = [rest for each, rest in everything[begin:] if each == word]
    return found


def installation() -> str:
    (made,) = [rest for word, rest in instructions() if word == "RUN" and "install.pyz" in rest]
    return made


def test_it_runs_without_rights_and_asks_no_index():
    assert only("USER") == "10001:10001"
    assert not re.search(r"\b(pip|apt-get|curl|wget|ADD)\b", DOCKERFILE.read_text())
    copied = [rest for word, rest in instructions() if word == "COPY"]
    assert copied == ["--from=install /opt/phil /opt/phil"]  # no bundle, so no private key
    assert installation().startswith("--mount=type=bind")


def test_no_private_key_is_left_and_its_folder_is_there_to_be_mounted(tmp_path):
    """What comes after the installer in the same layer, as its shell runs it."""
    release = tmp_path / "releases" / "1"
    (release / "tls").mkdir(parents=True)
    (release / "tls" / "key.pem").write_text("private")
    (tmp_path / "current").symlink_to("releases/1")
    installer, _, after = installation().partition(" && ")
    assert "install.pyz" in installer
    done = subprocess.run(
        ["sh", "-c", after.replace("/opt/phil", str(tmp_path))],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert list((release / "tls").iterdir()) == []


def test_the_runtime_is_the_first_process_as_a_unit_starts_it():
    """With the words and the folder of the systemd unit, which are proven on a board."""
    unit = (ROOT / "deploy/systemd/phil-edge.service").read_text().splitlines()
    assert f"ExecStart={' '.join(json.loads(only('ENTRYPOINT')))}" in unit
    assert f"WorkingDirectory={only('WORKDIR')}" in unit
