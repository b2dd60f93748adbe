"""What the READMEs point at is there, and what their pictures are drawn from."""

import os
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from deploy.bundle import TARGETS
from edge_runtime.cli import run_cli
from edge_runtime.util import UserError
from edge_runtime.vehicles.ros2.names import DEFAULT_ROS2_ENDPOINT
from hil_tests import pictures, processes
from hil_tests.__main__ import main
from hil_tests.pictures import FILM_POLICY, FILM_SEED, policy_sees, success_against_latency
from trainer.drivers import EXPERTS, TRIGGERS, load_driver, make_environment
from trainer.human.guide import HumanGuide
from trainer.picture import drive_moments

ROOT = Path(__file__).parents[2]
READMES = sorted(
    {
        path.relative_to(ROOT)
        for path in [*ROOT.glob("*.md"), *ROOT.glob("*/README.md"), *ROOT.glob("docs/*.md")]
        if ".venv" not in path.parts
    }
)


def test_every_folder_has_one():
    folders = ("edge_runtime", "bridge", "trainer", "hil_tests", "deploy")
    assert {Path(folder) / "README.md" for folder in folders} <= set(READMES)


def test_the_front_page_is_one_page():
    assert len((ROOT / "README.md").read_bytes()) <= 8192


def anchors(text: str) -> set[str]:
    """The names that GitHub gives a page's headings."""
    headings = re.findall(r"^#+ (.+)$", text, re.M)
    return {re.sub(r"[^\w\- ]", "", each.lower()).strip().replace(" ", "-") for each in headings}


@pytest.mark.parametrize("page", ["README.md", *(f"docs/{p.name}" for p in ROOT.glob("docs/*.md"))])
def test_a_link_into_a_page_meets_a_heading(page):
    for link, anchor in re.findall(r"\]\(([^)#:]*)#([^)]+)\)", (ROOT / page).read_text()):
        target = (ROOT / page).parent / link if link else ROOT / page
        assert anchor in anchors(target.read_text()), (link, anchor)


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


@pytest.mark.parametrize("readme", ["docs/first_day.md", "deploy/README.md"])
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
        (ROOT / "docs" / "first_day.md").read_text()
    )


DOCS = Path(__file__).parents[2] / "docs"


def test_the_table_of_pictures_is_that_of_the_command():
    text = (DOCS / "README.md").read_text()
    listed = re.findall(r"^\| \[(\S+)\]", text, re.M)
    assert set(pictures.PICTURES) <= set(listed)
    assert [name for name in listed if not (DOCS / name).is_file()] == []


def test_every_picture_is_small():
    heavy = [path.name for path in DOCS.glob("*.*") if path.stat().st_size > 2_000_000]
    assert heavy == []


def test_the_guide_in_the_film_brakes_for_the_crash_and_hands_the_wheel_back():
    env = make_environment("left_turn")
    driver, expert = (load_driver(name, env)[0] for name in (FILM_POLICY, "expert"))
    guide = HumanGuide(expert, TRIGGERS["left_turn"](EXPERTS["left_turn"](env)))
    moments = list(drive_moments(env, driver, guide, int(FILM_SEED), 15.0))
    taken = [number for number, each in enumerate(moments) if each.intervention]
    first = moments[taken[0]]
    assert first.intervention is not None
    assert (first.intervention.reason, first.action) == ("collision", -1.0)
    assert all(moments[number].action < 0.0 < moments[number].policy_action for number in taken)
    assert taken == list(range(taken[0], taken[-1] + 1))
    assert taken[-1] < len(moments) - 10
    assert env.distance_m > 20.0
    with Image.open(DOCS / "take_over.gif") as film:
        assert len(list(ImageSequence.Iterator(film))) == len(moments)


def test_pictures_of_what_is_kept_are_pictures(tmp_path):
    for make in (policy_sees, success_against_latency):
        out = tmp_path / f"{make.__name__}.png"
        make(out, tmp_path)
        with Image.open(out) as picture:
            assert min(picture.size) > 400
            assert len(np.unique(np.asarray(picture.convert("L")))) > 8


def test_one_that_cannot_be_made_does_not_keep_the_others_from_it(monkeypatch, tmp_path, capsys):
    def fail(_out, _work):
        raise UserError("no viewer here")

    def write(out, _work):
        out.write_bytes(b"picture")

    monkeypatch.setattr(pictures, "PICTURES", {"a.png": fail, "b.png": write})
    assert main(["pictures", "--out", str(tmp_path)]) == pictures.SOME_MISSING
    assert (tmp_path / "b.png").read_bytes() == b"picture"
    assert capsys.readouterr().err == "a.png: not made: no viewer here\n"
    assert main(["pictures", "b.png", "--out", str(tmp_path)]) == 0


@pytest.mark.parametrize(
    ("words", "part"),
    [(["x.png"], "no picture 'x.png'"), (["--out", "/dev/null"], "Not a directory")],
)
def test_bad_input_is_one_line(words, part, capsys):
    assert run_cli(main, ["pictures", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert part in line


def test_a_viewer_that_ends_as_it_draws_is_said(monkeypatch):
    monkeypatch.setattr(processes, "_connect_viewer", lambda viewer, _url: viewer)
    with pytest.raises(UserError, match="mesa-vulkan-drivers"), processes.headless_viewer():
        raise ConnectionError("transport error")
