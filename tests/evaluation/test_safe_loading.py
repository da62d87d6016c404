"""Models of strangers: rebuilt from JSON values and tensors, the rest refused by name, and nothing in their files is run."""

import io
import json
import pickle
import shutil
import stat
import zipfile

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hostile_files import Touch, rewrite, serialized, small
from made_runs import write_run
from sb3_contrib import TQC, TRPO, CrossQ
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from toy_envs import DotEnv

from sb3_por import SACCURL, SACMRQ, SACPOR, SACSPR, TQCPOR, SACDrQ
from sb3_por.__main__ import main
from sb3_por.common import plain
from sb3_por.common.errors import UserError, UserNote
from sb3_por.evaluation import load_safe, plain_files
from sb3_por.evaluation.loading import load_model
from sb3_por.evaluation.plain_files import save_plain
from sb3_por.runs.origin import MARKER, mark_as_own

POLICY = dict(net_arch=[8], features_extractor_kwargs=dict(features_dim=8, n_filters=2, strides=(2, 2)))


def por_model(**kwargs):
    return SACPOR("CnnPolicy", DotEnv(size=20), policy_kwargs=POLICY, buffer_size=20, device="cpu", **kwargs)


@pytest.fixture(scope="module")
def por_zip(tmp_path_factory):
    path = tmp_path_factory.mktemp("por") / "model.zip"
    por_model().save(path)
    return path


def actions(model):
    rng = np.random.default_rng(0)
    space = model.observation_space
    if isinstance(space, spaces.Dict):
        batches = {k: rng.integers(0, 2, (5, *part.shape)).astype(part.dtype) for k, part in space.spaces.items()}
    else:
        batches = rng.uniform(0, 1, (5, *space.shape)).astype(space.dtype)
    return model.predict(batches, deterministic=True)[0]


@pytest.mark.parametrize("cls", [SACPOR, TQCPOR, SACDrQ, SACCURL, SACSPR, SACMRQ])
@pytest.mark.parametrize("obs_type", ["pixels", "state", "dict"])
def test_own_models_are_rebuilt_from_their_description(cls, obs_type, tmp_path):
    policy = {"pixels": "CnnPolicy", "state": "MlpPolicy", "dict": "MultiInputPolicy"}[obs_type]
    kwargs = {"net_arch": [8], "activation_fn": th.nn.ELU}
    if obs_type == "pixels":
        kwargs["features_extractor_kwargs"] = POLICY["features_extractor_kwargs"]
    model = cls(policy, DotEnv(size=32, obs_type=obs_type), policy_kwargs=kwargs, buffer_size=20, device="cpu", gamma=0.9)
    model.save(tmp_path / "model.zip")
    loaded = load_safe(tmp_path / "model.zip", device="cpu")
    assert type(loaded) is cls and loaded.gamma == 0.9 and loaded.policy.activation_fn is th.nn.ELU
    assert loaded.policy.state_dict().keys() == model.policy.state_dict().keys()
    assert all(map(th.equal, loaded.policy.state_dict().values(), model.policy.state_dict().values()))
    assert loaded.observation_space == model.observation_space and loaded.action_space == model.action_space
    assert np.array_equal(actions(loaded), actions(model))


@pytest.mark.parametrize(
    "cls, env_id",
    [
        *((cls, "Pendulum-v1") for cls in (SAC, TD3, DDPG, TQC, CrossQ, PPO, A2C, TRPO)),
        *((cls, "CartPole-v1") for cls in (DQN, PPO)),
    ],
)
def test_models_of_sb3_get_their_spaces_from_the_environment(cls, env_id, tmp_path):
    model = cls("MlpPolicy", env_id, **small())
    model.save(tmp_path / "model.zip")
    loaded = load_safe(tmp_path / "model.zip", env_id, device="cpu")
    assert isinstance(model, type(loaded)) and np.array_equal(actions(loaded), actions(model))
    with pytest.raises(UserError, match="does not describe its spaces"):
        load_safe(tmp_path / "model.zip")


def test_a_plain_file_holds_no_pickle_and_plays_the_same(tmp_path):
    model = por_model()
    save_plain(model, tmp_path / "plain.zip")
    with zipfile.ZipFile(tmp_path / "plain.zip") as archive:
        assert b":serialized:" not in archive.read("data")
        assert archive.namelist() == ["data", "policy.pth", "_stable_baselines3_version"]
    for loaded in (load_safe(tmp_path / "plain.zip"), load_model(tmp_path / "plain.zip")):
        assert np.array_equal(actions(loaded), actions(model))
    names = set(plain_files.read_tensors(tmp_path / "plain.zip"))
    assert {name for name in model.policy.state_dict() if ".qf" not in name} == names
    with pytest.raises(UserError, match="is a model of 'SACPOR', not of sac_drq"):
        load_model(tmp_path / "plain.zip", algo="sac_drq")


@pytest.mark.parametrize("cls", [SACCURL, SACSPR, SACMRQ, SACDrQ])
def test_a_plain_file_goes_without_what_only_learning_needs(cls, tmp_path):
    model = cls("CnnPolicy", DotEnv(size=32), policy_kwargs=POLICY, buffer_size=20, device="cpu")
    save_plain(model, tmp_path / "plain.zip")
    names = set(plain_files.read_tensors(tmp_path / "plain.zip"))
    assert {name.split(".")[0] for name in names} == {"actor", "critic"} and not any(".qf" in name for name in names)
    loaded = load_safe(tmp_path / "plain.zip")
    assert np.array_equal(actions(loaded), actions(model))
    fresh = SACDrQ("CnnPolicy", DotEnv(size=32), policy_kwargs=POLICY, buffer_size=20, device="cpu")
    fresh.load_encoder(loaded)  # what it learned to see can be used
    encoders = (one.critic.features_extractor.state_dict() for one in (fresh, model))
    assert all(th.equal(a, b) for a, b in zip(*(encoder.values() for encoder in encoders), strict=True))
    target, own = (one.features_extractor.state_dict().values() for one in (loaded.critic_target, loaded.critic))
    assert all(map(th.equal, target, own))
    loaded.set_env(DotEnv(size=32))
    with pytest.raises(UserError, match="an exported agent only plays"):
        loaded.learn(10)


@pytest.mark.parametrize("which", ["por_zip", "sac_zip"])
def test_a_pickle_in_any_field_is_not_run(which, request, tmp_path, marker):
    path = request.getfixturevalue(which)
    env = DotEnv(size=20) if which == "por_zip" else "Pendulum-v1"
    with zipfile.ZipFile(path) as archive:
        data = json.loads(archive.read("data"))
    evil = serialized(Touch(marker))
    refused = set()
    for name in data:
        hostile = rewrite(path, tmp_path / "hostile.zip", data={name: evil})
        try:
            load_safe(hostile, env, device="cpu")
        except UserError:
            refused.add(name)
        assert not marker.exists(), name
    # What is needed; everything else is never read
    assert refused == ({"plain_description"} if which == "por_zip" else {"policy_class", "policy_kwargs"})
    everywhere = rewrite(path, tmp_path / "hostile.zip", data=dict.fromkeys(data, evil))
    with pytest.raises(UserError):
        load_safe(everywhere, env, device="cpu")
    assert not marker.exists()
    # The payload works: SB3 runs it
    rewrite(path, tmp_path / "hostile.zip", data={"lr_schedule": evil})
    with pytest.warns(UserNote, match="runs the code that is pickled in it"):
        load_model(tmp_path / "hostile.zip")
    assert marker.exists()


def evil_pth(marker, names):
    """A .pth whose pickle runs a command beside sound tensors."""
    good, bad = io.BytesIO(), io.BytesIO()
    th.save({name: th.zeros(2) for name in names}, good)
    with zipfile.ZipFile(good) as old, zipfile.ZipFile(bad, "w") as new:
        for name in old.namelist():
            new.writestr(name, pickle.dumps(Touch(marker), protocol=2) if name.endswith("data.pkl") else old.read(name))
    return bad.getvalue()


@pytest.mark.parametrize("form", ["pickle", "zip", "bytearray"])
@pytest.mark.parametrize(
    "member", ["policy.pth", "pytorch_variables.pth", "critic.optimizer.pth", "actor.optimizer.pth", "tensors.pth"]
)
def test_a_pickle_in_the_place_of_tensors_is_not_run(member, form, por_zip, tmp_path, marker):
    if form == "bytearray":  # PyTorch's safe reader calls bytearray(n)
        content = evil_pth(marker, "ab").replace(pickle.dumps(Touch(marker), protocol=2), b"")
        content = _with_pickle(b"\x80\x02c__builtin__\nbytearray\n\x8a\x05\x00\x00\x00\x00\x10\x85R.")
    else:
        content = pickle.dumps(Touch(marker)) if form == "pickle" else evil_pth(marker, "ab")
    hostile = rewrite(por_zip, tmp_path / "hostile.zip", {member: content})
    if member == "policy.pth":
        with pytest.raises(UserError, match=r"refused|safely"):
            load_safe(hostile)
    else:
        load_safe(hostile)
    assert not marker.exists()


def _with_pickle(content):
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("archive/data.pkl", content)
        file.writestr("archive/version", "3\n")
        file.writestr("archive/byteorder", "little")
    return archive.getvalue()


def test_the_refusal_of_tensors_names_what_is_wrong(por_zip, tmp_path, marker):
    hostile = rewrite(por_zip, tmp_path / "hostile.zip", {"policy.pth": evil_pth(marker, "a")})
    with pytest.raises(UserError, match=r"policy.pth in .* is refused: it names 'posix system'"):
        load_safe(hostile)


def test_tensors_that_claim_more_values_than_they_have_are_refused(por_zip, tmp_path):
    content = io.BytesIO()
    th.save({"actor.mu.weight": th.zeros(1).expand(10**9)}, content)
    hostile = rewrite(por_zip, tmp_path / "hostile.zip", {"policy.pth": content.getvalue()})
    with pytest.raises(UserError, match="is not a tensor with its values"):
        load_safe(hostile)


def test_oversized_members_are_refused_before_they_are_unpacked(por_zip, tmp_path, monkeypatch):
    big = bytes(plain_files.MAX_JSON + 1)
    hostile = rewrite(por_zip, tmp_path / "hostile.zip", {"data": big})
    assert hostile.stat().st_size < 2e5
    with pytest.raises(UserError, match="data in it unpacks to more than 32 MiB"):
        load_safe(hostile)
    monkeypatch.setattr(plain_files, "MAX_TENSORS", 2**20)
    hostile = rewrite(por_zip, tmp_path / "hostile.zip", {"policy.pth": bytes(2**20 + 1)})
    with pytest.raises(UserError, match=r"policy.pth in it unpacks to more than 1 MiB"):
        load_safe(hostile)
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, "w", zipfile.ZIP_DEFLATED) as pth:
        for i in range(3):
            pth.writestr(f"archive/data/{i}", bytes(2**19))
    hostile = rewrite(por_zip, tmp_path / "hostile.zip", {"policy.pth": inner.getvalue()})
    with pytest.raises(UserError, match=r"policy.pth in .* unpacks to more than 1 MiB"):
        load_safe(hostile)


@pytest.mark.parametrize("name", ["../evil.pth", "/tmp/evil.pth", "a/../../evil", "sub/policy.pth", "setup.py", "C:evil.pth"])
def test_members_that_no_model_has_are_refused_and_written_nowhere(name, por_zip, tmp_path):
    (tmp_path / "in").mkdir()
    hostile = rewrite(por_zip, tmp_path / "in" / "hostile.zip", {name: b"x"})
    with pytest.raises(UserError, match=r"refused: it has the member"):
        load_safe(hostile)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["hostile.zip"]


def test_a_symlink_is_read_as_the_bytes_that_it_is(por_zip, tmp_path):
    link = zipfile.ZipInfo("policy.pth")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    hostile = rewrite(por_zip, tmp_path / "hostile.zip", {"policy.pth": None})
    with zipfile.ZipFile(hostile, "a") as archive:
        archive.writestr(link, str(por_zip))
    with pytest.raises(UserError, match="cannot be loaded safely"):
        load_safe(hostile)


def test_two_members_of_one_name_are_refused(por_zip, tmp_path):
    hostile = tmp_path / "hostile.zip"
    shutil.copy(por_zip, hostile)
    with zipfile.ZipFile(hostile, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("data", "{}")
    with pytest.raises(UserError, match="two of one name"):
        load_safe(hostile)


ODD = [None, True, 3, -1, 10**12, 1e400, "x", "os.system", [], [[[]]], {}, {"class": "os.system"}, {"unknown": "x"}]


@pytest.mark.parametrize("field", ["algorithm", "policy", "policy_kwargs", "arguments", "observation_space", "action_space"])
def test_descriptions_of_the_wrong_type_are_refused(field, por_zip, tmp_path):
    description = plain_files.read_json(por_zip)[plain.ATTRIBUTE]
    for value in ODD:
        hostile = rewrite(por_zip, tmp_path / "hostile.zip", data={plain.ATTRIBUTE: description | {field: value}})
        if (field, value) == ("arguments", {}):
            continue  # all of them have defaults
        with pytest.raises(UserError) as error:
            load_safe(hostile)
        assert "\n" not in str(error.value)
    for content in (b"[]", b"3", b"{", b"[" * 100_000, b'{"plain_description": []}'):
        with pytest.raises(UserError):
            load_safe(rewrite(por_zip, tmp_path / "hostile.zip", {"data": content}))


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(net_arch=[10**9]),
        dict(net_arch=[1] * 100_000),
        dict(net_arch={"pi": [10**5, 10**5], "qf": [8]}),
        dict(n_critics=10**9),
        dict(features_extractor_kwargs=dict(n_filters=10**9, strides=[2, 2], features_dim=8)),
        dict(features_extractor_kwargs=dict(n_filters=2, strides=[2, 2], features_dim=10**9)),
        dict(features_extractor_kwargs=dict(n_filters=2, strides=[1] * 10_000, features_dim=8)),
        dict(net_arch="import os"),
        dict(activation_fn="torch.nn.ReLU"),
        dict(activation_fn={"class": "subprocess.Popen"}),
        dict(features_extractor_class={"class": "toy_envs.DotEnv"}),
        dict(no_such_argument=1),
    ],
    ids=lambda kwargs: str(kwargs)[:50],
)
def test_arguments_of_a_policy_that_ask_for_too_much_are_refused(kwargs, por_zip, tmp_path):
    description = plain_files.read_json(por_zip)[plain.ATTRIBUTE]
    changed = {**description, "policy_kwargs": {**description["policy_kwargs"], **kwargs}}
    hostile = rewrite(por_zip, tmp_path / "hostile.zip", data={plain.ATTRIBUTE: changed})
    with pytest.raises(UserError):
        load_safe(hostile)


@pytest.mark.parametrize(
    "space", [dict(shape=[10**9]), dict(shape=[-1]), dict(dtype="O"), dict(low="x"), dict(shape=[3, 16, 16])]
)
def test_spaces_that_cannot_be_the_models_are_refused(space, por_zip, tmp_path):
    description = plain_files.read_json(por_zip)[plain.ATTRIBUTE]
    changed = {**description, "observation_space": {**description["observation_space"], **space}}
    with pytest.raises(UserError):
        load_safe(rewrite(por_zip, tmp_path / "hostile.zip", data={plain.ATTRIBUTE: changed}))


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(np.array([-1.0, -np.inf]), np.array([1.0, np.inf]), dtype=np.float64),
        spaces.Box(0, 255, (3, 8, 8), np.uint8),
        spaces.Dict({"a": spaces.Discrete(3, start=-1), "b": spaces.MultiBinary([2, 3]), "c": spaces.MultiBinary(4)}),
        spaces.MultiDiscrete([2, 5]),
    ],
    ids=lambda space: type(space).__name__,
)
def test_a_space_is_made_from_its_description(space):
    assert plain.make_space(json.loads(json.dumps(plain.describe_space(space)))) == space


def test_a_class_that_is_not_known_is_refused_by_name(tmp_path):
    class Strange(th.nn.ReLU):
        pass

    model = SACPOR("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs=dict(activation_fn=Strange), device="cpu")
    save_plain(model, tmp_path / "model.zip")
    with pytest.raises(UserError, match=r"policy_kwargs: activation_fn is refused: safe loading does not know the class '"):
        load_safe(tmp_path / "model.zip")


@pytest.mark.parametrize("command", ["evaluate", "enjoy", "diagnose", "saliency", "record", "rank"])
def test_safe_is_an_argument_of_every_command_with_a_model(command, sac_zip, tmp_path, marker, capsys, monkeypatch):
    hostile = rewrite(sac_zip, tmp_path / "hostile.zip", data={"policy_kwargs": serialized(Touch(marker))})
    outputs = {
        "enjoy": ["-o", "v.gif"],
        "saliency": ["-o", "s.png"],
        "record": ["-n", "1", "-o", "dataset"],
        "rank": ["-o", "ranker.npz"],
    }
    monkeypatch.chdir(tmp_path)
    assert main([command, "--model", str(hostile), "--env", "Pendulum-v1", "--safe", *outputs.get(command, [])]) == 2
    assert "hostile.zip cannot be loaded safely: " in capsys.readouterr().err
    assert not marker.exists()


def test_safe_evaluation_has_the_same_scores(sac_zip, capsys):
    for flags in ([], ["--safe"]):
        assert main(["evaluate", "--model", str(sac_zip), "--env", "Pendulum-v1", "-n", "1", *flags]) == 0
    unsafe, safe = capsys.readouterr().out.splitlines()
    assert unsafe == safe


def test_models_that_were_written_here_are_loaded_without_a_note(sac_zip, tmp_path, monkeypatch, recwarn):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    run = tmp_path / "run"
    run.mkdir()
    shutil.copy(sac_zip, run / "best_model.zip")
    mark_as_own(run)
    assert stat.S_IMODE((tmp_path / "state" / "sb3_por" / "key").stat().st_mode) == 0o600
    load_model(run)
    assert not [one for one in recwarn if one.category is UserNote]
    # Another place, another user, another marker
    shutil.copytree(run, tmp_path / "moved")
    with pytest.warns(UserNote, match=r"was not written by train.py here"):
        load_model(tmp_path / "moved")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other"))
    with pytest.warns(UserNote, match=r"was not written by train.py here"):
        load_model(run)
    mark_as_own(tmp_path / "moved")
    shutil.copy(tmp_path / "moved" / MARKER, run / MARKER)
    with pytest.warns(UserNote, match=r"was not written by train.py here"):
        load_model(run)


def test_the_models_of_a_folder_are_diagnosed_safely(por_zip, tmp_path, marker, capsys):
    run = write_run(tmp_path, env="FallingBall-v0")
    rewrite(por_zip, run / "FallingBall-v0.zip", data={"lr_schedule": serialized(Touch(marker))})
    main(["diagnose", str(tmp_path), "-n", "1", "--safe"])
    assert not marker.exists()
