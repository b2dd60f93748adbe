import hashlib

import numpy as np
import onnx
import pytest
import torch

from bridge import policy_file
from bridge.policy_file import try_policy
from deploy.certs import write_key_pair
from edge_runtime.policy import UNSIGNED, check_graph, load_policy, open_policy
from edge_runtime.util import UserError
from trainer.environments import make_environment
from trainer.learner.networks import Actor
from trainer.policy_file import Export, export_policy, write_policy

LABEL = {"scenario": "left_turn", "algorithm": "phil_td3", "seed": 4, "episode": 12}


def make_actor(frames: int = 2) -> Actor:
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        actor = Actor(frames=frames)
        # Large weights: a policy whose actions spread over the whole range.
        actor.head.output.weight.mul_(20)
    return actor


@pytest.fixture(scope="module")
def exported() -> Export:
    return export_policy(make_actor(), LABEL, {"gamma": 0.95}, make_environment("left_turn"))


@pytest.fixture(autouse=True)
def few_observations(exported, monkeypatch):
    """Of an export in a test; the one that they share had all."""
    monkeypatch.setattr(policy_file, "REAL_OBSERVATIONS", 20)


def test_the_file_is_what_the_contract_says(exported):
    model = onnx.load_from_string(exported.model)
    assert model.ir_version == 8
    assert [(entry.domain, entry.version) for entry in model.opset_import] == [("", 17)]
    assert exported.policy_id == hashlib.sha256(exported.model).hexdigest()
    assert "policy_id" not in check_graph(exported.model)["phil.manifest"]
    (frames,), (action,) = model.graph.input, model.graph.output
    assert (frames.name, action.name) == ("frames", "action")
    shape = [d.dim_param or d.dim_value for d in frames.type.tensor_type.shape.dim]
    assert shape == ["batch", 2, 45, 80]
    assert frames.type.tensor_type.elem_type == onnx.TensorProto.UINT8


def test_parity_is_measured_and_a_difference_seen(exported):
    assert 0 < exported.max_difference < 1e-5
    env, asked, changed = make_environment("left_turn"), [], make_actor()
    with torch.no_grad():
        changed.head.output.bias.add_(0.01)

    def act(entries):
        asked.append(entries["frames"].copy())
        return changed.act(asked[-1][None])[0]

    with pytest.raises(UserError, match="differ by"):
        try_policy(open_policy(exported.model, UNSIGNED), env, exported.model, act)
    assert len(np.unique(np.stack(asked), axis=0)) >= 19
    assert np.std([changed.act(frames[None])[0] for frames in asked]) > 0.003


def test_the_edge_runtime_drives_a_signed_file_and_agrees_with_torch(exported, tmp_path):
    private, public = write_key_pair(tmp_path / "keys")
    path = tmp_path / "policy.onnx"
    write_policy(exported.model, path, private)
    policy = load_policy(path, public_key=public)
    assert policy.manifest.training["seed"] == 4
    assert policy.manifest.training["config"] == {"gamma": 0.95}
    assert policy.manifest.action[0].name == "pedal"
    for frames in np.random.default_rng(0).integers(0, 256, (10, 2, 45, 80), np.uint8):
        with torch.no_grad():
            wanted = make_actor()(torch.from_numpy(frames)[None])[0].numpy()
        np.testing.assert_allclose(policy.act({"frames": frames}), wanted, atol=1e-5)
    # An unsigned export removes the signature of an older file.
    write_policy(exported.model, path, None)
    assert not (tmp_path / "policy.onnx.sig").exists()
