"""The report as a page, one self-contained HTML file, and as JUnit's XML."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, tostring

import jinja2
import msgspec
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from bridge.messages import Scene
from bridge.recording import Recording, choose_vehicle, valid_messages
from hil_tests.accept.checks import AXES, DRIVE, DRIVE_FILE
from trainer.scenarios.picture import HEIGHT_M, WIDTH_M, draw_scene

PASSED, FAILED, NOT_TRIED = "passed", "failed", "not_tried"
JUNIT = {PASSED: "system-out", FAILED: "failure", NOT_TRIED: "skipped"}
FRAMES, FRAME_PIXELS, STRIPS = 6, (368, 200), 3
GOOD, BAD, PLAIN = "#2b7a4b", "#b3322e", "#2868b8"


def junit(report: Mapping[str, Any]) -> bytes:
    results = [check["result"] for check in report["checks"]]
    counts = {"failures": results.count(FAILED), "skipped": results.count(NOT_TRIED)}
    figures = {"name": "accept", "tests": len(results), **counts, "time": report["seconds"]}
    suite = Element("testsuite", {key: str(value) for key, value in figures.items()})
    for check in report["checks"]:
        case = SubElement(suite, "testcase", classname="accept", name=check["name"])
        end = SubElement(case, JUNIT[check["result"]])
        end.text = f"asked: {check['asked']}; measured: {check['measured']}"
        if check["why"]:
            end.set("message", check["why"])
    return bytes(tostring(suite, encoding="utf-8", xml_declaration=True))


def render(folder: Path, report: Mapping[str, Any]) -> str:
    """Return the page; its frames come from the recording in the folder."""
    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), undefined=jinja2.StrictUndefined,
        autoescape=True, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    data = report["data"]
    places = {f"link: distance to the limit of {axis}": axis for axis in AXES}
    figures = [draw_distance(axis, data[name]) for name, axis in places.items() if name in data]
    figures += [draw_times(data[DRIVE])] if DRIVE in data else []
    return templates.get_template("page.html.jinja").render(
        **report, took=timedelta(seconds=round(report["seconds"])),
        figures=[*map(svg, figures)], name=Path(report["policy"]).name,
        strips=list(strips(folder / DRIVE_FILE, data[DRIVE]["outcomes"])) if DRIVE in data else [],
    )  # fmt: skip


def draw_distance(axis: str, found: Mapping[str, Any]) -> Figure:
    figure, unit = Figure(figsize=(4.6, 3.0), layout="constrained"), AXES[axis][-1]
    panel, declared = figure.subplots(), found["declared"]
    at, shares = zip(*sorted((float(x), y) for x, y in found["points"].items()), strict=True)
    value, low, high, _ = np.array(shares).T
    panel.errorbar(at, value, [value - low, high - value], fmt="o-", ms=4, capsize=3, color=PLAIN)
    asked = f"asked: {100 * found['least']:g} %, of the interval's lower end"
    panel.axhline(found["least"], color="0.4", lw=0.9, ls="--", label=asked)
    panel.axvline(declared, color=BAD, lw=1.6, label=f"declared link: {declared:g} {unit}")
    if found["limit"]:
        panel.axvspan(0.0, found["limit"], color=GOOD, alpha=0.12, label="enough")
    panel.set(xlabel=f"{axis} each way, {unit}", ylabel="success", ylim=(-0.03, 1.05))
    panel.legend(fontsize=8)
    return figure


def draw_times(found: Mapping[str, Any]) -> Figure:
    figure = Figure(figsize=(4.6, 3.0), layout="constrained")
    panel, period_ms = figure.subplots(), found["period_ms"]
    times_ms = np.maximum(found["edge_ms"], 0.01)
    p99_ms, most_ms = np.percentile(times_ms, 99), max(times_ms.max(), period_ms)
    panel.hist(times_ms, [*np.geomspace(0.8 * times_ms.min(), 1.3 * most_ms, 48)], color=PLAIN)
    panel.axvline(p99_ms, color="0.3", lw=1.0, ls="--", label=f"p99: {p99_ms:.2f} ms")
    panel.axvline(period_ms, color=BAD, lw=1.6, label=f"T: {period_ms:g} ms")
    panel.set_xscale("log")
    panel.xaxis.set_major_formatter("{x:g}")
    panel.set(xlabel="state received to command sent, ms", ylabel="answers")
    panel.legend(fontsize=8)
    return figure


def svg(figure: Figure) -> str:
    drawn = io.StringIO()
    without = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(drawn, format="svg", metadata=without)
    return drawn.getvalue()[drawn.getvalue().index("<svg") :]


def strips(path: Path, outcomes: list[str]) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """Yield some recorded drives, failed ones first: title, and frames as (time, data URL)."""
    films: dict[int, list[Scene]] = {}
    recording = Recording(path)
    for _, message in valid_messages(recording, choose_vehicle(recording, None)):
        if isinstance(message, Scene) and (message.vehicles or message.picture):
            films.setdefault(message.episode, []).append(message)
    for episode in sorted(films, key=lambda each: outcomes[each] == "goal")[:STRIPS]:
        film = films[episode]
        places = np.linspace(0, len(film) - 1, min(FRAMES, len(film))).round().astype(int)
        frames = [(f"{film[at].sim_time_s:.1f} s", picture_of(film[at])) for at in places]
        yield f"Drive {episode + 1}: {outcomes[episode]}", frames


def picture_of(scene: Scene) -> str:
    """Return the scene around the car, or else the picture, as an image's data URL."""
    if scene.picture:
        picture: Image.Image = Image.open(io.BytesIO(scene.picture))
    else:
        car = next((each for each in scene.vehicles if each.ego), scene.vehicles[0])
        view = (car.x - WIDTH_M / 2, car.y - HEIGHT_M / 2)
        picture = Image.fromarray(draw_scene({**msgspec.to_builtins(scene), "view": view}))
    picture.thumbnail(FRAME_PIXELS)
    packed = io.BytesIO()
    picture.save(packed, "WEBP", quality=70)
    return f"data:image/webp;base64,{base64.b64encode(packed.getvalue()).decode()}"
