"""``python -m deploy policy``: any ONNX model becomes a policy file, or says why it cannot."""

import numpy as np
import onnx
import onnx.parser
import pytest
from onnx import helper, numpy_helper

from deploy.__main__ import main
from deploy.certs import write_key_pair
from edge_runtime.policy import VERIFIED, load_policy
from hil_tests.tests.shared.commands import exit_status

PENDULUM = "(float[b, 3] obs) => (float[b, 1] out)"
TORQUE = "cos = Slice(obs, zero, one, one) out = Mul(cos, two)"
STOP = ("--set", "action.0.stop=0")


def write_model(path, graph, opset=17, ir_version=8):
    made = onnx.parser.parse_graph(f"g {graph}")
    for name, number in (("zero", [0]), ("one", [1]), ("two", np.float32(2)), ("ends", [2])):
        made.initializer.append(numpy_helper.from_array(np.asarray(number), name))
    opsets = [helper.make_opsetid("", opset)]
    onnx.save(helper.make_model(made, opset_imports=opsets, ir_version=ir_version), str(path))


def policy(tmp_path, *options):
    out = tmp_path / "out.onnx"
    words = [
        "policy",
        str(tmp_path / "model.onnx"),
        "--env",
        "Pendulum-v1",
        "--out",
        str(out),
        *options,
    ]
    return exit_status(main, words), out


@pytest.mark.parametrize(("opset", "ir_version"), [(13, 7), (21, 10)])
def test_a_model_with_names_of_its_own_becomes_a_signed_policy(tmp_path, capsys, opset, ir_version):
    write_model(tmp_path / "model.onnx", f"{PENDULUM} {{ {TORQUE} }}", opset, ir_version)
    key, public = write_key_pair(tmp_path / "keys")
    more = ("--set", "action.0.slew_per_s=50", "--set", "action.0.unit=N m", "--algorithm", "hand")
    status, out = policy(tmp_path, *STOP, *more, "--key", str(key))
    assert status == 0
    made = load_policy(out, public)
    manifest = made.manifest
    assert (made.trust, manifest.task, manifest.algorithm) == (VERIFIED, "Pendulum-v1", "hand")
    assert manifest.control_period_s == 0.05
    (row,) = manifest.action
    assert (row.low, row.high, row.stop, row.slew_per_s, row.unit) == (-2.0, 2.0, 0.0, 50.0, "N m")
    seen = {"observation": np.array([0.25, 0.0, 0.0], np.float32)}
    assert made.act(seen) == pytest.approx([0.5])
    assert "it drives Pendulum-v1: observation float32 3" in capsys.readouterr().out


def test_the_period_that_is_asked_for_wins(tmp_path):
    write_model(tmp_path / "model.onnx", f"{PENDULUM} {{ {TORQUE} }}")
    status, out = policy(tmp_path, *STOP, "--period", "0.2")
    assert status == 0
    assert load_policy(out, allow_unsigned=True).manifest.control_period_s == 0.2


@pytest.mark.parametrize(
    ("graph", "options", "match"),
    [
        ("(float[b, 4] obs) => (float[b, 1] out) { " + TORQUE + " }", STOP, "must be observation"),
        (f"{PENDULUM} {{ {TORQUE} }}", (), "does not say how action_0 stops safely; give --set"),
        (f"{PENDULUM} {{ {TORQUE} }}", ("--set", "action.0.stop=9"), "stop between"),
        (f"{PENDULUM} {{ {TORQUE} }}", ("--set", "action.1.stop=0"), "N from 0 to 0"),
        (f"{PENDULUM} {{ {TORQUE} }}", ("--set", "action.0.low=0"), "expected action.N.stop"),
    ],
)  # fmt: skip
def test_what_cannot_drive_is_one_line_and_leaves_no_file(tmp_path, capsys, graph, options, match):
    write_model(tmp_path / "model.onnx", graph)
    status, out = policy(tmp_path, *options)
    (line,) = capsys.readouterr().err.splitlines()
    assert status == 2
    assert match.replace("\\", "") in line
    assert not out.exists()


@pytest.mark.parametrize(
    ("answer", "layer", "expected"),
    [
        ("Mul(cos, two)", "Identity(obs)", 0),
        ("Mul(cos, one_f)", "Identity(obs)", 1),  # within -1 to 1 of -2 to 2
        ("Mul(cos, two)", "Mul(obs, million)", 1),  # as of observations in other units
        ("Mul(cos, one_f)", "Mul(obs, million)", 2),
    ],
)  # fmt: skip
def test_answers_and_observations_in_other_units_are_warned_of(
    tmp_path, capsys, answer, layer, expected
):
    hidden = f"big = {layer} wide = MatMul(big, weights) mean = ReduceMean<axes=[1]>(wide)"
    nothing = "gone = Mul(mean, zero_f) torque = Add(whole, gone) out = Clip(torque, less, two)"
    write_model(
        tmp_path / "model.onnx",
        f"{PENDULUM} <float[3, 4] weights = {{{', '.join(['1'] * 12)}}}, float zero_f = {{0}}, "
        f"float one_f = {{1}}, float million = {{1000000}}, float less = {{-2}}> "
        f"{{ cos = Slice(obs, zero, one, one) whole = {answer} {hidden} {nothing} }}",
    )
    status, _ = policy(tmp_path, *STOP)
    assert status == 0
    assert capsys.readouterr().err.count("warning:") == expected
