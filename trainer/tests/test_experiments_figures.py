"""Every figure from a made-up store: what is there, what is partly there, and nothing at all."""

from typing import Any

import pytest

from trainer.experiments import timing
from trainer.experiments.catalogue import EXPERIMENTS
from trainer.experiments.figures.style import LABELS, write_figure
from trainer.learner.algorithms import ALGORITHMS
from trainer.tests.synthetic import gathered

CURVES = {"fig7": 4, "fig11": 3, "fig12": 3, "fig13": 3, "ablation": 4, "remedy": 5, "switches": 7,
          "network": 2}  # fmt: skip
"""Experiment -> curves in each panel."""
PANELS = {"fig8": 8, "fig9": 3, "fig10": 2, "fig14": 3, "fig15": 6, "table1": 1, "table2": 1}
SEEDS = 2


def draw(name: str, without=lambda unit: False) -> Any:
    units = EXPERIMENTS[name].units(SEEDS)
    return EXPERIMENTS[name].draw(gathered(units, SEEDS, filter(without, units)))


def texts(figure: Any) -> str:
    found = [text.get_text() for panel in figure.axes for text in panel.texts]
    for panel in figure.axes:
        found += [panel.get_xlabel(), panel.get_title(loc="left")]
        found += [label.get_text() for label in panel.get_xticklabels()]
        if panel.get_legend():
            found += [text.get_text() for text in panel.get_legend().get_texts()]
    return "\n".join(found)


@pytest.mark.parametrize("name", CURVES)
def test_learning_curves_have_a_line_and_a_band_for_each_algorithm(name):
    figure = draw(name)
    assert len(figure.axes) == 6
    for panel in figure.axes:
        # The policy alone is drawn where it was validated: after every tenth episode.
        title = panel.get_title(loc="left")
        # Means of twenty episodes begin at the twentieth.
        points = 10 if "without help" in title else 81
        # The printed reward is on a scale of its own.
        wanted = CURVES[name] - (name == "switches" and "reward" in title)
        curves = [line for line in panel.get_lines() if len(line.get_xdata()) == points]
        assert len(curves) == len(panel.collections) == wanted
        assert len({(line.get_color(), line.get_linestyle()) for line in curves}) == wanted
        assert curves[0].get_xdata()[0] == (10 if points == 10 else 20)
        assert curves[0].get_xdata()[-1] == 100
    assert "training episode" in figure.get_supxlabel()
    assert texts(figure).count(f"({SEEDS} of {SEEDS} seeds)") == 2 * CURVES[name]


@pytest.mark.parametrize("name", PANELS)
def test_other_figures_have_their_panels(name, tmp_path):
    figure = draw(name)
    assert len(figure.axes) == PANELS[name]
    assert "no data yet" not in texts(figure)
    write_figure(figure, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_each_box_says_of_how_many_drives_it_is():
    figure = draw("fig10")
    boxes = sum(len(panel.patches) for panel in figure.axes)
    assert sum(line.isdigit() for line in texts(figure).splitlines()) == boxes > 0


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_missing_seed_is_said_in_the_figure(name, tmp_path):
    figure = draw(name, lambda unit: (unit.algorithm, unit.seed) == ("phil_td3", 2))
    marks = {
        "fig8": "1 + 1 seeds",
        "fig9": "1 of 2 seeds",
        "fig10": "(seeds: 1)",
        "fig14": "1 seeds",
    }
    assert marks.get(name, "(1 of 2 seeds)" if name in CURVES else "(1)") in texts(figure)
    write_figure(figure, tmp_path / "figure.png")


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_figure_of_nothing_can_be_drawn(name, tmp_path):
    figure = draw(name, lambda unit: True)
    write_figure(figure, tmp_path / "figure.png")
    assert (
        "no data yet" in texts(figure)
        or "(0 of 2 seeds)" in texts(figure)
        or "(0)" in texts(figure)
    )


def test_the_heat_map_shows_the_share_of_all_seeds():
    units = EXPERIMENTS["fig9"].units(SEEDS)
    made = gathered(units, SEEDS)
    reached = [o.tests["nominal"].reached for o in made.of("left_turn", "per_td3")]
    share = sum(map(sum, reached)) / sum(map(len, reached))
    figure: Any = EXPERIMENTS["fig9"].draw(made)
    heat = figure.axes[0]
    assert heat.texts[3].get_text() == f"{100 * share:.0f}%"
    assert heat.images[0].get_array()[0, 3] == pytest.approx(share)


def test_bars_are_as_high_as_the_means():
    made = gathered(EXPERIMENTS["fig8"].units(SEEDS), SEEDS)
    tough = made.of("left_turn", "ia_td3", "tough")
    finals = [outcome.metrics["distance_m"][-20:].mean() for outcome in tough]
    figure: Any = EXPERIMENTS["fig8"].draw(made)
    panel = figure.axes[1]
    assert panel.patches[3].get_height() == pytest.approx(sum(finals) / SEEDS)


def test_time_is_drawn_with_and_without_a_measurement(tmp_path):
    turns = {name: [(100, 3.0), (100, 5.0)] for name in timing.PAPER_S}
    assert texts(timing.draw(turns)).count("400 s") == 4
    assert "no data yet" in texts(timing.draw(None))


def test_every_algorithm_has_a_name_in_the_figures():
    assert set(ALGORITHMS) <= set(LABELS)
