"""Which policies may drive; and no byte of one, nor of its signature, can change: all are tried."""

import json
import random
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from hil_tests.tests.shared.policies import (
    PEDAL,
    ROVER,
    ROVER_INPUTS,
    SHAPE,
    STEERING,
    WHEELS,
    public_pem,
    write_policy,
    write_rover,
)
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from onnx import TensorProto, helper

from edge_runtime import policy as module
from edge_runtime.manifest import MANIFEST_KEY, Action, Entry, decode_manifest
from edge_runtime.policy import check_graph, infer, load_policy, verify
from edge_runtime.util import UserError
from edge_runtime.wire import MAX_TEXT_CHARS, Reason

POLICIES = Path(module.__file__).parents[1] / "results" / "policies"


def action(name, low=-1.0, high=1.0, **changes):
    return Action(name=name, low=low, high=high, **changes)


def refused(path, match, **options):
    with pytest.raises(UserError, match=f"^.*{match}.*$"):  # a dot is no new line
        load_policy(path, **options)


@pytest.fixture
def plain(tmp_path):
    return tmp_path / "p.onnx"


ONE_AT_A_TIME = {**ROVER_INPUTS, "camera": "uint8[1, 4, 6, 3]"}


@pytest.mark.parametrize("kinds", [ROVER_INPUTS, ONE_AT_A_TIME])
def test_a_policy_of_any_observation_and_action_drives(plain, kinds):
    write_rover(plain, kinds)
    policy = load_policy(plain, allow_unsigned=True)
    seen = {name: np.zeros(entry.shape, entry.dtype) for name, entry in ROVER.items()}
    seen["ranges"][:] = -3.0, 7.5
    packed = {name: array.tobytes() for name, array in seen.items()}
    assert policy.layout.refusal(packed) is None
    assert policy.act(policy.layout.arrays(packed)).tolist() == [-30.0, 75.0]
    for wrong, reason in (
        ({"ranges": np.array([0, np.nan], np.float32).tobytes()}, Reason.NOT_FINITE),
        ({"lit": b"\x02"}, Reason.OBSERVATION),
        ({"camera": bytes(71)}, Reason.OBSERVATION),
    ):
        refusal = policy.layout.refusal({**packed, **wrong})
        assert refusal is not None
        assert refusal.reason is reason


@pytest.mark.parametrize(
    ("kinds", "changes"),
    [
        ({"ranges": ROVER_INPUTS["ranges"]}, {}),
        ({**ROVER_INPUTS, "more": "float[b]"}, {}),
        ({**ROVER_INPUTS, "camera": "float[b, 4, 6, 3]"}, {}),
        ({**ROVER_INPUTS, "camera": "uint8[b, 6, 4, 3]"}, {}),
        ({**ROVER_INPUTS, "camera": "uint8[2, 4, 6, 3]"}, {}),
        ({**ROVER_INPUTS, "lit": "float[b]"}, {}),
        (ROVER_INPUTS, {"action": WHEELS[:1]}),
    ],
)
def test_inputs_and_output_must_be_the_manifests(plain, kinds, changes):
    write_rover(plain, kinds, **changes)
    refused(plain, "its (input|output)", allow_unsigned=True)


@pytest.mark.parametrize(
    "public_key",
    [
        public_pem(Ed25519PrivateKey.generate()), b"not a key",
        public_pem(X25519PrivateKey.generate()), None,
    ],
)  # fmt: skip
def test_another_key_or_none_is_refused(make_policy, public_key):
    signed = make_policy()
    signed.public_key.unlink()
    if public_key:
        signed.public_key.write_bytes(public_key)
    refused(signed.path, "public key", public_key=signed.public_key, allow_unsigned=True)


@pytest.mark.parametrize("shape", [(1, 0), (2, 1), (1, 2), ()])
def test_an_answer_of_another_shape_than_one_row_of_actions_is_none(plain, shape):
    """Probe pictures cannot find it out: the shape may hang on the picture."""
    write_policy(plain)
    session = SimpleNamespace(run=lambda *_: [np.full(shape, 0.5, np.float32)])
    policy = load_policy(plain, allow_unsigned=True)._replace(session=session)
    frames = {"frames": np.zeros(SHAPE, np.uint8)}
    assert infer(policy, frames)[0] is None


def test_the_task_is_all_that_both_sides_agree_on_and_fits_the_wire(plain):
    write_policy(plain, value=0.1, actions=(PEDAL, action("steering", -0.5, 0.25)))
    manifest = load_policy(plain, allow_unsigned=True).manifest
    said = "frames uint8 2x45x80, pedal -1 to 1, steering -0.5 to 0.25, every 0.1 s"
    assert manifest.text == f"left_turn: {said}"
    texts = [replace(manifest, task="s" * count).text for count in (300, 301)]
    assert {len(text) for text in texts} == {MAX_TEXT_CHARS}
    assert len(set(texts)) == 2  # though they begin alike


def test_trust_without_a_key_or_signature(make_policy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    signed, plain = make_policy(), tmp_path / "plain.onnx"
    write_policy(plain)
    for path, match, trust in (
        (signed.path, "no public key", module.UNVERIFIED),
        (plain, "not signed", module.UNSIGNED),
    ):
        refused(path, match)
        policy = load_policy(path, allow_unsigned=True)
        assert (policy.trust, policy.public_key) == (trust, None)
    # The one in the working directory is found.
    (tmp_path / "keys").mkdir()
    signed.public_key.rename(tmp_path / "keys" / "policy.pub")
    policy = load_policy(signed.path)
    verified = module.VERIFIED, str(tmp_path / "keys" / "policy.pub")
    assert (policy.trust, policy.public_key) == verified


def test_a_key_beside_the_policy_is_not_trusted(make_policy, tmp_path, monkeypatch):
    """Whoever brings a policy can bring a key, too; the one of the working directory is mine."""
    (tmp_path / "home" / "keys").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "home")
    mine = Path("keys/policy.pub")
    mine.write_bytes(public_pem(Ed25519PrivateKey.generate()))
    signed = make_policy()
    refused(signed.path, f"public key {mine}: .* --public-key", allow_unsigned=True)
    beside = signed.public_key.rename(tmp_path / "policy.pub")
    assert load_policy(signed.path, allow_unsigned=True).trust == module.BESIDE
    assert load_policy(signed.path, beside).trust == module.VERIFIED
    for options in ({}, {"public_key": mine, "allow_unsigned": True}):
        refused(signed.path, f"public key {mine}: .* --public-key", **options)
    mine.unlink()
    refused(signed.path, "no public key")


MANIFESTS: dict = {
    "output": {"action": [PEDAL, STEERING]},
    "actions": {"action": []},
    "control period is 0.0099": {"control_period_s": 0.0099},
    "control period is 1.001": {"control_period_s": 1.001},
    "schema 1": {"schema": 1},
    "0 arrays": {"observation": {}},
    "float64": {"observation": {"frames": Entry(dtype="float64", shape=[2, 45, 80])}},
    "of shape": {"observation": {"frames": Entry(dtype="uint8", shape=[2, 0, 80])}},
    "4190208": {"observation": {"frames": Entry(dtype="uint8", shape=[4096, 1024])}},
    "input": {"observation": {"frames": Entry(dtype="float32", shape=[2, 45, 80])}},
}
OPTIONS: dict = {
    "opset 12": {"opset": 12},
    "opset 22": {"opset": 22},
    "IR version 11": {"ir_version": 11},
    "outside": {"value": 1.5},
    "nan": {"value": float("nan")},
    "low below high": {"actions": (action("x", low=0.5, high=0.5),)},
    "not valid": {"actions": (action("x", high=float("inf")),)},  # JSON has no such number
    "stop between": {"actions": (action("x", stop=1.5),)},
    "slew_per_s above 0": {"actions": (action("x", slew_per_s=0.0),)},
    "2 actions": {"actions": (PEDAL, PEDAL)},
    "601 actions": {"actions": [action(f"a{i}") for i in range(601)]},
    **{word: {"manifest_changes": changes} for word, changes in MANIFESTS.items()},
}


@pytest.mark.parametrize("word", OPTIONS)
def test_manifest_and_graph_must_agree(plain, word):
    write_policy(plain, **OPTIONS[word])
    refused(plain, word, allow_unsigned=True)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "plain.onnx"
    write_policy(path)
    return path


def refused_or_without_manifest(data: bytes) -> bool:
    try:
        return MANIFEST_KEY not in check_graph(data)
    except UserError:
        return True


def test_what_the_onnx_package_wrote_is_read_and_every_truncation_refused(written):
    """A cut between two fields can leave a whole model, but then the manifest is gone."""
    data = written.read_bytes()
    text = check_graph(data)[MANIFEST_KEY]
    earlier = json.dumps({**json.loads(text), "envelope": {"joint": "ignored"}})
    assert decode_manifest(text) == decode_manifest(earlier)
    for length in range(len(data)):
        assert refused_or_without_manifest(data[:length]), length


@given(st.data())
def test_foreign_and_damaged_bytes_raise_only_user_errors(written, data):
    assert refused_or_without_manifest(data.draw(st.binary(max_size=200)))
    damaged = bytearray(written.read_bytes())
    damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    refused_or_without_manifest(bytes(damaged))


def outside(tensor=None):
    tensor = tensor or helper.make_tensor("w", TensorProto.FLOAT, [1], [1.0])
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="../elsewhere.bin")
    return tensor


def sparse():
    places = helper.make_tensor("places", TensorProto.INT64, [1], [0])
    return helper.make_sparse_tensor(outside(), places, [2])


def constant(**value):
    return helper.make_node("Constant", [], ["c"], **value)


def function():
    opset, body = helper.make_opsetid("", 17), [constant(value=outside())]
    return helper.make_function("mine", "f", [], ["c"], body, [opset])


HIDDEN: dict = {
    "an initializer in another file": lambda m: outside(m.graph.initializer[0]),
    "a constant in another file": lambda m: m.graph.node.append(constant(value=outside())),
    "a sparse initializer": lambda m: m.graph.sparse_initializer.append(sparse()),
    "a sparse constant": lambda m: m.graph.node.append(constant(sparse_value=sparse())),
    "a branch": lambda m: m.graph.node.append(helper.make_node("If", [], [], then=m.graph)),
    "a function": lambda m: m.functions.append(function()),
    "training": lambda m: m.training_info.add().algorithm.initializer.append(outside()),
    "no operator set": lambda m: m.ClearField("opset_import"),
}


@pytest.mark.parametrize("place", HIDDEN)
def test_weights_that_may_lie_outside_the_file_are_refused(written, place):
    model = onnx.load(str(written))
    model.graph.initializer[0].data_location = TensorProto.DEFAULT  # it says where it is
    check_graph(model.SerializeToString())
    HIDDEN[place](model)
    with pytest.raises(UserError):
        check_graph(model.SerializeToString())


@pytest.mark.parametrize(
    ("added", "what"),
    [
        # Protobuf takes 32 bits of a tag: of 2**32 + (25 << 3) + 2 field 25, the model's functions.
        (b"\xca\x81\x80\x80\x10\0", "field 536870937"),
        (b"\x38\x01", "whole"),  # field 7, the graph
        (None, "2 graphs"),  # the file once more: a protobuf library merges them into one
    ],
)
def test_what_protobuf_would_read_in_another_way_is_refused(written, added, what):
    data = written.read_bytes()
    with pytest.raises(UserError, match=what):
        check_graph(data + (data if added is None else added))


def network(answer):
    """A network of its own with the mean of the picture, which `answer` makes an action of."""
    return f"""own (uint8[batch, 2, 45, 80] frames) => (float[batch, 1] action) {{
        pixels = Cast<to = 1>(frames)
        mean = ReduceMean<axes = [1, 2, 3], keepdims = 0>(pixels)
        whole = Cast<to = 7>(mean)
        {answer}
    }}"""


LEVEL = "row = Unsqueeze(mean, last_axis)"
BY_OBSERVATION = {
    "Range": "end = Squeeze(whole) many = Range(end, end, end) action = Cast<to = 1>(many)",
    "Expand": "action = Expand(zero, whole)",
    "ConstantOfShape": "action = ConstantOfShape(whole)",
    "Tile": "action = Tile(ones, whole)",
    "Slice": "action = Slice(ones, whole, whole)",
    "Pad": "action = Pad(ones, whole)",
    "TopK": f"{LEVEL} action, places = TopK(row, whole)",
    "NonZero": "places = NonZero(mean) action = Cast<to = 1>(places)",
    "Compress": "lit = Cast<to = 9>(whole) action = Compress(ones, lit)",
    "LSTM": "action = LSTM<hidden_size = 1>(pixels, ones, ones, zero, whole)",
    "ReduceMax": "action = ReduceMax(pixels, whole)",
    "Shape": "some = NonZero(mean) size = Shape(some) action = Expand(zero, size)",
}
AT_RANDOM = {
    "RandomUniform": "action = RandomUniform<shape = [1, 1]>()",
    "RandomNormalLike": f"{LEVEL} action = RandomNormalLike(row)",
    "Bernoulli": f"{LEVEL} action = Bernoulli(row)",
    "Multinomial": f"{LEVEL} drawn = Multinomial(row) action = Cast<to = 1>(drawn)",
    "Dropout": f"{LEVEL} yes = Cast<to = 9>(zero) action = Dropout(row, zero, yes)",
}


@pytest.mark.parametrize(
    ("name", "answer", "why"),
    [
        *((name, answer, module._COST) for name, answer in BY_OBSERVATION.items()),
        *((name, answer, module._RANDOM) for name, answer in AT_RANDOM.items()),
        ("Mine", "action = someones.Mine(mean)", "not ONNX's own"),
    ],
)
def test_neither_cost_nor_answer_may_be_left_to_the_observation_or_to_chance(
    plain, name, answer, why
):
    write_policy(plain, graph=network(answer))
    refused(plain, f"operator ({name}|NonZero) .*{why}", allow_unsigned=True)


def test_sizes_that_follow_from_weights_and_shapes_may_drive(plain):
    """As exporters write them: the batch's size, a range of it, a tensor made as large."""
    answer = f"""{LEVEL} size = Shape(row) one = Size(row) none = Sub(one, one)
        whole_steps = Range(none, one, one) steps = Cast<to = 1>(whole_steps)
        room = ConstantOfShape(size) wide = Expand(room, size) nothing = Mul(row, zero)
        left = Dropout(nothing) sum = Add(wide, left) all = Add(sum, steps)
        action = Reshape(all, size)"""
    write_policy(plain, graph=network(answer))
    policy = load_policy(plain, allow_unsigned=True)
    assert policy.act({"frames": np.full(SHAPE, 9, np.uint8)}).tolist() == [0.0]


def test_numbers_near_zero_are_taken_for_zero(plain):
    """A dark picture makes this network's numbers subnormal, and those take ten times as long.

    In a process of its own: the first session of a process decides.
    """
    answer = f"{LEVEL} dim = Mul(row, faint) dimmer = Mul(dim, faint) action = Div(dimmer, faint)"
    write_policy(plain, graph=network(answer))
    act = f"""if True:
        import numpy as np, threading
        from edge_runtime.policy import load_policy
        load = lambda: load_policy({str(plain)!r}, allow_unsigned=True)
        policies = [load(), load()]
        def act():
            for policy in policies:
                print(policy.act({{"frames": np.ones({SHAPE}, np.uint8)}}).tolist())
        act()
        other = threading.Thread(target=act)
        other.start()
        other.join()
        print(np.float32(1e-20) * np.float32(1e-20) > 0.0)  # elsewhere nothing is changed"""
    done = subprocess.run([sys.executable, "-c", act], capture_output=True, text=True, check=True)
    assert sorted(done.stdout.split("\n")) == ["", "True", *["[0.0]"] * 4]


GROUP_ORDER = 2**252 + 27742317777372353535851937790883648493  # of Ed25519, RFC 8032


def changed(data, place, flip):
    return data[:place] + bytes([data[place] ^ flip]) + data[place + 1 :]


def test_every_byte_of_a_small_policy_and_every_bit_of_its_signature_count(make_policy):
    signed, draw = make_policy(), random.Random(1)
    data, signature = signed.path.read_bytes(), Path(f"{signed.path}.sig").read_bytes()
    public_key, half = signed.public_key.read_bytes(), len(data) // 2
    verify(data, signature, public_key)
    # S plus the group's order solves the same equation; it must not pass as another file.
    number = int.from_bytes(signature[32:], "little") + GROUP_ORDER
    others = [
        *((changed(data, place, draw.randint(1, 255)), signature) for place in range(len(data))),
        *((data, changed(signature, bit // 8, 1 << bit % 8)) for bit in range(8 * 64)),
        *((other, signature) for other in (b"", data[:-1], data[1:], data + b"\0", b"\0" + data)),
        (data[half:] + data[:half], signature),
        (data, signature[:32] + number.to_bytes(32, "little")),
        *((data, other) for other in (signature[:-1], signature + b"\n", b"", bytes(64))),
    ]
    for policy, other in others:
        with pytest.raises(UserError):
            verify(policy, other, public_key)
