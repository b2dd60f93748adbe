"""The report as a page, one self-contained HTML file, and as JUnit's XML."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import jinja2
import msgspec
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from bridge.messages import Scene, images_of
from bridge.outcomes import Estimate
from bridge.recording import Recording, valid_messages
from edge_runtime.manifest import Layout
from edge_runtime.wire import State
from hil_tests.accept.checks import AXES, DRIVE, DRIVE_FILE
from hil_tests.accept.job import FAILED, NOT_TRIED, PASSED, VEHICLE_ID, Row
from trainer.scenarios.picture import HEIGHT_M, WIDTH_M, draw_scene

FRAMES, FRAME_PIXELS, STRIPS = 6, (368, 200), 3
RESULTS = {FAILED: "failed", NOT_TRIED: "not tried", PASSED: "passed"}
GOOD, BAD, PLAIN = "#2b7a4b", "#b3322e", "#2868b8"


def render(folder: Path, report: dict[str, Any], rows: list[Row]) -> str:
    """Return the page of a report."""
    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), undefined=jinja2.StrictUndefined,
        autoescape=True, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    by_result = {result: [row for row in rows if row.result == result] for result in RESULTS}
    data = {row.name: row.data for row in rows if row.data}
    return templates.get_template("page.html.jinja").render(
        report=report, by_result=by_result, words=RESULTS, figures=list(figures(data)),
        strips=list(strips(folder, data.get(DRIVE, {}))),
        took=timedelta(seconds=round(report["seconds"])),
    )  # fmt: skip


def junit(report: dict[str, Any]) -> bytes:
    """Return the checks as JUnit's XML: a test case each."""
    checks = report["checks"]
    counts = {"failures": FAILED, "skipped": NOT_TRIED}
    told = {key: str(sum(c["result"] == value for c in checks)) for key, value in counts.items()}
    told |= {"name": "accept", "tests": str(len(checks)), "time": f"{report['seconds']:.1f}"}
    suite = ElementTree.Element("testsuite", told)
    for check in checks:
        case = ElementTree.SubElement(suite, "testcase", classname="accept", name=check["name"])
        said = f"asked: {check['asked']}; measured: {check['measured']}"
        if (kind := {FAILED: "failure", NOT_TRIED: "skipped"}.get(check["result"])) is not None:
            ElementTree.SubElement(case, kind, message=check["why"]).text = said
        else:
            ElementTree.SubElement(case, "system-out").text = said
    return bytes(ElementTree.tostring(suite, encoding="utf-8", xml_declaration=True))


def figures(data: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield titles with drawings, as SVG: success against delay and loss, times against T."""
    for axis, (_, _, _, unit) in AXES.items():
        if found := data.get(f"distance to the limit of {axis}"):
            yield f"Success against {axis} each way", svg(draw_distance(axis, unit, found))
    if times_ms := data.get(DRIVE, {}).get("edge_ms"):
        yield "Time of the edge runtime for an answer", svg(draw_times(times_ms, data[DRIVE]))


def draw_distance(axis: str, unit: str, found: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(4.6, 3.0), layout="constrained")
    panel = figure.subplots()
    points = sorted((float(x), Estimate(*share)) for x, share in found["points"].items())
    at, shares = zip(*points, strict=True)
    values, low, high, _ = np.array(shares).T
    panel.errorbar(
        at, values, [values - low, high - values], fmt="o-", ms=4, capsize=3, color=PLAIN
    )
    panel.axhline(found["least"], color="0.4", lw=0.9, ls="--", label=f"{found['least']:.0%} asked")
    declared = found["declared"]
    panel.axvline(declared, color=BAD, lw=1.6, label=f"declared link: {declared:g} {unit}")
    if found["limit"] is not None:
        panel.axvspan(0, found["limit"], color=GOOD, alpha=0.12, label="holds")
    panel.set(xlabel=f"{axis} each way, {unit}", ylabel="success", ylim=(-0.03, 1.05))
    panel.set_xlim(left=-0.03 * max(*at, declared, 1.0))
    panel.legend(loc="lower left", fontsize=8)
    return figure


def draw_times(times_ms: list[float], found: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(4.6, 3.0), layout="constrained")
    panel, period_ms = figure.subplots(), found["period_ms"]
    shown = np.maximum(times_ms, 1e-2)
    bins = np.geomspace(shown.min() * 0.8, max(shown.max(), period_ms) * 1.3, 48)
    panel.hist(shown, bins=bins.tolist(), color=PLAIN)
    panel.axvline(period_ms, color=BAD, lw=1.6, label=f"T = {period_ms:g} ms")
    panel.axvline(np.percentile(shown, 99), color="0.3", lw=1.0, ls="--",
                  label=f"p99 = {np.percentile(shown, 99):.2f} ms")  # fmt: skip
    panel.set(xscale="log", xlabel="state received to command sent, ms", ylabel="answers")
    panel.legend(fontsize=8)
    return figure


def svg(figure: Figure) -> str:
    drawn = io.StringIO()
    figure.savefig(drawn, format="svg", metadata={"Date": None})
    return drawn.getvalue().partition("<svg")[1] + drawn.getvalue().partition("<svg")[2]


def strips(folder: Path, found: dict[str, Any]) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """Yield for some recorded drives, the failed first, the outcome and frames with their times."""
    if not (outcomes := found.get("outcomes")):
        return
    drawn: dict[int, list[tuple[float, Image.Image]]] = {}
    layout, picture = None, None
    for _, message in valid_messages(Recording(folder / DRIVE_FILE), VEHICLE_ID):
        if isinstance(message, Scene):
            layout = Layout(message.task) if message.task else layout
            picture = picture_of(message)
        elif isinstance(message, State) and picture is None and layout:
            picture = seen_by(layout, message)
        if picture is not None and isinstance(message, Scene | State):
            drawn.setdefault(message.episode, []).append((message.sim_time_s, picture))
    ends = sorted(drawn, key=lambda episode: outcomes[episode] == "goal")
    for episode in ends[:STRIPS]:
        film = drawn[episode]
        places = np.linspace(0, len(film) - 1, min(FRAMES, len(film))).round().astype(int)
        frames = [(f"{film[place][0]:.1f} s", embedded(film[place][1])) for place in places]
        yield f"Drive {episode + 1}: {outcomes[episode]}", frames


def picture_of(scene: Scene) -> Image.Image | None:
    """Draw a scene around the car, or return the picture that came in its place."""
    if scene.picture:
        return Image.open(io.BytesIO(scene.picture)).convert("RGB")
    egos = [car for car in scene.vehicles if car.ego]
    if not egos:
        return None
    view = (egos[0].x - WIDTH_M / 2, egos[0].y - HEIGHT_M / 2)
    return Image.fromarray(draw_scene({**msgspec.to_builtins(scene), "view": view}))


def seen_by(layout: Layout, state: State) -> Image.Image | None:
    """Return the first picture of an observation."""
    for array in layout.arrays(state.observation).values() if state.observation else ():
        if (images := images_of(array)) is not None:
            return Image.fromarray(images[-1].squeeze())
    return None


def embedded(picture: Image.Image) -> str:
    """Return a small WebP as the address of an image."""
    small, packed = picture.convert("RGB"), io.BytesIO()
    small.thumbnail(FRAME_PIXELS)
    small.save(packed, "WEBP", quality=70)
    return f"data:image/webp;base64,{base64.b64encode(packed.getvalue()).decode()}"
