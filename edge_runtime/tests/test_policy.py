from __future__ import annotations

import hashlib
import re
from pathlib import Path

import numpy as np
import onnx
import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from onnx import helper

import edge_runtime
from edge_runtime import policy_file
from edge_runtime.policy import infer, load_policy
from edge_runtime.policy_file import task_text
from edge_runtime.tests.policies import PEDAL, STEERING, public_pem, write_policy
from edge_runtime.util import UserError
from edge_runtime.wire import MAX_TEXT_CHARS

KEY = Ed25519PrivateKey.generate()


def action(name, low=-1.0, high=1.0):
    return type(PEDAL)(name=name, meaning="m", unit="u", low=low, high=high)


def refused(path, match, **options):
    with pytest.raises(UserError, match=match) as caught:
        load_policy(path, **options)
    assert "\n" not in str(caught.value)


def test_a_signed_policy_drives(make_policy):
    signed = make_policy("mean")
    policy = load_policy(signed.path, signed.public_key)
    assert policy.trust == policy_file.VERIFIED
    assert policy.policy_id == signed.policy_id
    for level in (0, 51, 255):
        action = policy.act(np.full((2, 45, 80), level, np.uint8))
        assert action.dtype == np.float32
        np.testing.assert_allclose(action, [level / 127.5 - 1], atol=1e-6)


@pytest.mark.parametrize("shape", [(1, 0), (2, 1), (1, 2), (), (1,), (0, 1), (1, 1, 1)])
def test_an_answer_of_another_shape_than_one_row_of_actions_is_none(tmp_path, shape):
    """Probe pictures cannot find it out: the shape hangs on the picture."""
    write_policy(tmp_path / "p.onnx", "odd", odd_shape=shape)
    policy = load_policy(tmp_path / "p.onnx", allow_unsigned=True)
    assert policy.act(np.zeros((2, 45, 80), np.uint8)).shape == (1,)
    white = np.full((2, 45, 80), 255, np.uint8)
    with pytest.raises(UserError, match=re.escape(f"float32 {list(shape)}")):
        policy.act(white)
    assert infer(policy, white).output is None


def test_two_files_that_act_differently_never_share_an_id(tmp_path):
    """One of the same weights that answers full throttle whatever it sees, for a start."""
    paths = [tmp_path / name for name in ("good.onnx", "bad.onnx")]
    write_policy(paths[0], "mean")
    model = onnx.load(str(paths[0]))
    model.graph.node[-1].output[0] = "unused"
    model.graph.node.append(helper.make_node("Sign", ["mean"], ["sign"]))
    model.graph.node.append(helper.make_node("Abs", ["sign"], ["throttle"]))
    model.graph.node.append(helper.make_node("Unsqueeze", ["throttle", "last_axis"], ["action"]))
    onnx.save(model, str(paths[1]))
    good, bad = (load_policy(path, allow_unsigned=True) for path in paths)
    assert bad.act(np.full((2, 45, 80), 9, np.uint8)) == [1.0]
    assert good.policy_id != bad.policy_id


@pytest.mark.parametrize("scenario", ["left_turn", "congestion"])
def test_a_policy_from_before_with_an_id_in_its_manifest_still_drives(scenario):
    root = Path(edge_runtime.__file__).parents[1] / "results" / "policies"
    path = root / f"{scenario}.onnx"
    assert b'"policy_id":' in path.read_bytes()
    policy = load_policy(path, root / "policy.pub")
    assert policy.trust == policy_file.VERIFIED
    assert policy.policy_id == hashlib.sha256(path.read_bytes()).hexdigest()


def test_the_task_is_scenario_and_actions_and_fits_the_wire(tmp_path):
    write_policy(tmp_path / "p.onnx", value=0.1, actions=(PEDAL, action("steering", -0.5, 0.25)))
    manifest = load_policy(tmp_path / "p.onnx", allow_unsigned=True).manifest
    assert manifest.task == "left_turn, pedal -1 to 1, steering -0.5 to 0.25"
    assert len(task_text("s" * 300, [])) == MAX_TEXT_CHARS


def test_two_actions(tmp_path):
    write_policy(tmp_path / "p.onnx", value=-0.25, actions=(PEDAL, STEERING))
    policy = load_policy(tmp_path / "p.onnx", allow_unsigned=True)
    np.testing.assert_allclose(policy.act(np.zeros((2, 45, 80), np.uint8)), [-0.25, -0.25])


@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=30
)
@given(position=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
def test_one_changed_byte_is_refused_whatever_the_flags(make_policy, position, flip):
    signed = make_policy()
    data = bytearray(signed.path.read_bytes())
    data[int(position * len(data))] ^= flip
    signed.path.write_bytes(bytes(data))
    for allow_unsigned in (False, True):
        refused(
            signed.path, "signature", public_key=signed.public_key, allow_unsigned=allow_unsigned
        )


def test_a_changed_or_short_signature_is_refused(make_policy):
    signed = make_policy()
    signature_path = signed.path.with_name(signed.path.name + ".sig")
    good = signature_path.read_bytes()
    names = f"{re.escape(str(signature_path))}, public key {re.escape(str(signed.public_key))}"
    for bad in (bytes([good[0] ^ 1]) + good[1:], good[:-1], good + b"\n", b"", bytes(64)):
        signature_path.write_bytes(bad)
        refused(signed.path, names, public_key=signed.public_key, allow_unsigned=True)


def test_another_key_is_refused(make_policy, tmp_path):
    signed = make_policy()
    other = tmp_path / "other.pub"
    other.write_bytes(public_pem(Ed25519PrivateKey.generate()))
    refused(signed.path, "another key signed it", public_key=other, allow_unsigned=True)


def test_a_key_that_is_none_is_refused(make_policy, tmp_path):
    signed = make_policy()
    key = tmp_path / "bad.pub"
    key.write_bytes(b"not a key")
    refused(signed.path, "not a PEM public key", public_key=key)
    key.write_bytes(
        X25519PrivateKey.generate()
        .public_key()
        .public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
    )
    refused(signed.path, "not an Ed25519 key", public_key=key)
    refused(signed.path, "does not exist", public_key=tmp_path / "absent.pub")


def test_trust_without_a_key_or_signature(make_policy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    signed = make_policy()
    refused(signed.path, "no public key")
    assert load_policy(signed.path, allow_unsigned=True).trust == policy_file.UNVERIFIED
    write_policy(tmp_path / "plain.onnx")
    refused(tmp_path / "plain.onnx", "not signed")
    assert load_policy(tmp_path / "plain.onnx", allow_unsigned=True).trust == policy_file.UNSIGNED


def test_the_public_key_in_the_working_directory_is_found(make_policy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    signed = make_policy()
    (tmp_path / "keys").mkdir()
    signed.public_key.rename(tmp_path / "keys" / "policy.pub")
    assert load_policy(signed.path).trust == policy_file.VERIFIED


def test_a_key_beside_the_policy_counts_only_where_its_maker_does_not(
    make_policy, tmp_path, monkeypatch
):
    """Whoever brings a policy can bring a key, too; the one of the working directory is mine."""
    (tmp_path / "home" / "keys").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "home")
    mine = Path("keys/policy.pub")
    mine.write_bytes(public_pem(Ed25519PrivateKey.generate()))
    signed = make_policy()
    refused(signed.path, f"public key {mine}: .* --public-key", allow_unsigned=True)
    beside = signed.public_key.rename(tmp_path / "policy.pub")
    assert load_policy(signed.path, allow_unsigned=True).trust == policy_file.BESIDE
    assert load_policy(signed.path, beside).trust == policy_file.VERIFIED
    for options in ({}, {"public_key": mine, "allow_unsigned": True}):
        refused(signed.path, f"public key {mine}: .* --public-key", **options)
    mine.unlink()
    refused(signed.path, "no public key")


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"manifest_changes": {"action": [PEDAL, STEERING]}}, "its output must be action"),
        ({"manifest_changes": {"action": []}}, "no action"),
        ({"manifest_changes": {"control_period_s": 0.05}}, "control period"),
        ({"manifest_changes": {"schema": 2}}, "schema 2"),
        ({"opset": 16}, "opset 16"),
        ({"ir_version": 9}, "IR version 9"),
        ({"value": 1.5}, "outside its manifest's"),
        ({"value": float("nan")}, "not finite"),
        ({"actions": (action("horn"),)}, "does not know how to stop"),
        ({"actions": (action("pedal", low=0.0),)}, "could not brake"),
        ({"actions": (action("steering", low=0.5, high=0.5),)}, "it must lie in -1 to 1"),
        ({"actions": (action("steering", high=1.5),)}, "it must lie in -1 to 1"),
        ({"actions": (PEDAL, PEDAL)}, "names an action twice: pedal, pedal"),
    ],
)
def test_manifest_and_graph_must_agree(tmp_path, options, match):
    write_policy(tmp_path / "p.onnx", **options)
    refused(tmp_path / "p.onnx", match, allow_unsigned=True)


def _rename(graph):
    graph.input[0].name = graph.node[0].input[0] = "pictures"


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (_rename, r"pictures tensor\(uint8\) \['batch', 2, 45, 80\]"),
        (lambda g: setattr(_input(g), "elem_type", onnx.TensorProto.FLOAT), r"tensor\(float\)"),
        (lambda g: setattr(_input(g).shape.dim[2], "dim_value", 46), "'batch', 2, 46, 80"),
        (lambda g: setattr(_input(g).shape.dim[0], "dim_value", 2), "2, 2, 45, 80"),
        (lambda g: g.input.append(helper.make_tensor_value_info("more", 1, [1])), "more tensor"),
    ],
)
def test_a_graph_of_another_input_is_refused(tmp_path, change, found):
    write_policy(tmp_path / "p.onnx")
    model = onnx.load(str(tmp_path / "p.onnx"))
    change(model.graph)
    onnx.save(model, str(tmp_path / "p.onnx"))
    refused(tmp_path / "p.onnx", rf"its input must be frames .*{found}", allow_unsigned=True)


def _input(graph):
    return graph.input[0].type.tensor_type


def test_what_onnxruntime_prints_stays_off_stdout(tmp_path, monkeypatch, capfd):
    def fail(*_, **__):
        print("EP Error")
        raise ValueError("broken\ngraph")

    monkeypatch.setattr("onnxruntime.InferenceSession", fail)
    write_policy(tmp_path / "p.onnx")
    refused(tmp_path / "p.onnx", "broken graph", allow_unsigned=True)
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89PNG\r\n\x1a\n" + bytes(99)])
def test_foreign_files_are_refused(tmp_path, content):
    (tmp_path / "p.onnx").write_bytes(content)
    refused(tmp_path / "p.onnx", "not a whole ONNX file", allow_unsigned=True)


def test_absent_files_and_directories_are_refused(tmp_path):
    refused(tmp_path / "absent.onnx", "does not exist")
    refused(tmp_path, "is a directory")
