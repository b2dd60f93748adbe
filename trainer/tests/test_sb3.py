"""``python -m deploy policy`` with the files that Stable-Baselines3 saves."""

import base64
import json
import zipfile
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from edge_runtime.policy import load_policy
from hil_tests.tests.shared.commands import call, refusal
from trainer import sb3

STOP = ("--set", "action.0.stop=0")
SMALL = {"net_arch": [16, 8]}


def program(path):
    """A pickle that makes a file where it is run."""
    return f"cposix\nsystem\n(S'touch {path}'\ntR.".encode()


def calls(place, *arguments):
    """A pickle that calls `module:name`; arguments are pickles without their ends."""
    return "c{}\n{}\n(".format(*place.split(":")).encode() + b"".join(arguments) + b"tR"


NUMBERS, OBJECTS, ADDRESS = b"V>f8\n", b"VO\n", b"C\x08AAAAAAAA"
FIELD = b"(I3\nV<\nN(Va\nt}Va\n(" + calls("numpy:dtype", OBJECTS) + b"I0\ntsI8\nI1\nI0\ntb"
"""The state of a type of numbers, after which it is one of objects."""
HOLDS_ADDRESSES = [
    calls("numpy:ndarray", b"(I1\nt", OBJECTS, ADDRESS),
    calls("numpy:ndarray", b"(I1\nt", calls("numpy:dtype", OBJECTS), ADDRESS),
    calls("numpy._core.multiarray:scalar", calls("numpy:dtype", NUMBERS) + FIELD, ADDRESS),
]
LAUGHS = b"N" + 22 * b"2\x86"  # Pairs of the same pair
OWN = b"(dS'features_extractor_class'\ncsomebody.else\nExtractor\ns."


def behind_normaliser():
    wrapped: Any = VecNormalize(DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")]), clip_obs=1.5)
    wrapped.obs_rms.mean, wrapped.obs_rms.var = (
        np.array([0.3, -0.2, 1.0]),
        np.array([0.1, 2.0, 9.0]),
    )
    return wrapped


def policy(capsys, tmp_path, model, *options, env="Pendulum-v1"):
    out = tmp_path / "out.onnx"
    words = ["policy", model, "--env", env, *STOP, "--out", out, *options]
    return call(capsys, *words, package="deploy"), out


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (SAC, {"policy_kwargs": {**SMALL}}),
        (TD3, {"policy_kwargs": {**SMALL}}),
        (DDPG, {"policy_kwargs": {**SMALL}}),
        (A2C, {"policy_kwargs": {**SMALL}}),
        (PPO, {"policy_kwargs": {**SMALL, "activation_fn": torch.nn.ReLU}}),
        (PPO, {"use_sde": True, "policy_kwargs": {**SMALL, "squash_output": True}}),
    ],
)
def test_it_answers_as_the_library_behind_its_normalisation(
    capsys, tmp_path, one_thread, kind, options
):
    wrapped, saved, pickled = behind_normaliser(), tmp_path / "m.zip", tmp_path / "v.pkl"
    made = kind("MlpPolicy", wrapped, seed=1, device="cpu", **options)
    with torch.no_grad():  # Answers that reach both ends of the range
        for weights in made.policy.parameters():
            torch.nn.init.normal_(weights, std=0.7)
    made.save(saved)
    wrapped.save(pickled)
    (status, out, err), file = policy(capsys, tmp_path, saved, "--normalise", pickled)
    assert (status, err) == (0, "")
    assert "library" in out
    ready = load_policy(file, allow_unsigned=True)
    assert ready.manifest.algorithm == kind.__name__.lower()
    seen = np.random.default_rng(0).normal(0.0, 3.0, (100, 3)).astype(np.float32)
    loaded = kind.load(saved, device="cpu")
    wanted, _ = loaded.predict(wrapped.normalize_obs(seen), deterministic=True)
    got = [ready.act({"observation": each}) for each in seen]
    assert np.abs(np.array(got) - wanted).max() < 1e-5
    assert np.abs(wanted).max() > 1.0


@pytest.fixture(scope="module")
def ppo(tmp_path_factory):
    path = tmp_path_factory.mktemp("ppo") / "m.zip"
    kwargs: Any = {**SMALL, "features_extractor_class": FlattenExtractor}
    sizes: Any = {"n_steps": 8, "batch_size": 8}
    PPO("MlpPolicy", "Pendulum-v1", device="cpu", policy_kwargs=kwargs, **sizes).save(path)
    return path


def changed(path, out, **values):
    with zipfile.ZipFile(path) as archive, zipfile.ZipFile(out, "w") as copy:
        for name in archive.namelist():
            data = archive.read(name)
            if name == "data":
                packed = {
                    key: {":serialized:": base64.b64encode(value).decode()}
                    for key, value in values.items()
                }
                data = json.dumps(json.loads(data) | packed).encode()
            copy.writestr(name, data)
    return out


@pytest.mark.parametrize("key", ["policy_class", "policy_kwargs", "observation_space"])
def test_what_a_file_would_run_is_not_run(capsys, tmp_path, ppo, key):
    evil = changed(ppo, tmp_path / "evil.zip", **{key: program(tmp_path / "pwned")})
    refusal(capsys, "policy", evil, "--env", "Pendulum-v1", *STOP, "--out", tmp_path / "o.onnx",
            package="deploy")  # fmt: skip
    (tmp_path / "evil.pkl").write_bytes(program(tmp_path / "pwned"))
    (status, _, _), out = policy(capsys, tmp_path, ppo, "--normalise", tmp_path / "evil.pkl")
    assert status == 2
    assert not (tmp_path / "pwned").exists()
    assert not out.exists()


@pytest.mark.parametrize("pickled", HOLDS_ADDRESSES)
def test_a_number_never_passes_for_the_address_of_an_object(pickled):
    with pytest.raises(TypeError):
        sb3._read(pickled + b".")


@pytest.mark.parametrize("key", ["action_space", "observation_space", "policy_kwargs"])
def test_a_refusal_shows_nothing_that_a_pickle_can_blow_up(capsys, tmp_path, ppo, key):
    path = changed(ppo, tmp_path / "laughs.zip", **{key: LAUGHS + b"."})
    (status, _, err), out = policy(capsys, tmp_path, path)
    assert (status, len(err.splitlines())) == (2, 1)
    assert len(err) < 500
    assert not out.exists()


def test_what_has_a_normalisers_names_alone_is_refused(capsys, tmp_path, ppo):
    kind = "stable_baselines3.common.running_mean_std\nRunningMeanStd"
    state = b"}Vnormalize_obs\nI1\nsVnorm_obs\nI00\ns"
    (tmp_path / "v.pkl").write_bytes(f"c{kind}\n".encode() + b")\x81" + state + b"b.")
    (status, _, err), _ = policy(capsys, tmp_path, ppo, "--normalise", tmp_path / "v.pkl")
    assert (status, len(err.splitlines())) == (2, 1)


def test_what_does_not_fit_is_refused(capsys, tmp_path, one_thread, ppo):
    wrapped, normalised = behind_normaliser(), tmp_path / "n.zip"
    PPO("MlpPolicy", wrapped, n_steps=8, batch_size=8, device="cpu").learn(8).save(normalised)
    own = changed(ppo, tmp_path / "own.zip", policy_kwargs=OWN)
    (tmp_path / "text.zip").write_text("text")
    (tmp_path / "model.onnx").write_text("")
    for words in (
        (normalised,),  # --normalise is missing
        (own,),
        (tmp_path / "text.zip",),
        (tmp_path / "none.zip",),
        (tmp_path / "model.onnx", "--normalise", tmp_path / "v.pkl"),
    ):
        (status, _, err), out = policy(capsys, tmp_path, *words)
        assert (status, len(err.splitlines())) == (2, 1), words
        assert not out.exists()
    other = {"env": "MountainCarContinuous-v0"}
    (status, _, err), _ = policy(capsys, tmp_path, ppo, "--period", "0.1", **other)
    assert (status, len(err.splitlines())) == (2, 1)
    assert "-2.0, 2.0" in err
