"""Bad input, drawn at random: one clear line and exit code 2, never a traceback, never half a file."""

import io
import uuid
import zipfile
from contextlib import redirect_stderr, redirect_stdout

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from toy_envs import DotEnv

from sb3_por import SACPOR
from sb3_por.__main__ import COMMANDS, main
from sb3_por.common.errors import UserError
from sb3_por.suites.suite_file import read_suite
from sb3_por.training.zoo import main as train
from softbody_envs.env import OBS_TYPES
from softbody_envs.rendering import RENDERERS
from softbody_envs.tasks.falling_ball import FallingBallEnv
from softbody_envs.variations import SPLITS

EXAMPLES = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
#: Words that some command knows, beside words that none does
WORDS = st.one_of(
    st.sampled_from(["--model", "--env", "-n", "--seed", "-o", "--kind", "--metric", "--step", "--csv", "--json", "--algo"]),
    st.sampled_from(
        ["expert", "random", "PourWater-v0", "pourwater-v0", "no_such", "-1", "0", "1e3", "x.gif", "x.txt", "", "sac"]
    ),
    st.text(alphabet=st.characters(blacklist_categories=["Cs", "Cc"]), max_size=8),
)


def outcome(command, arguments):
    """Exit code and lines on standard error; the exit of argparse's --help counts as 0."""
    errors = io.StringIO()
    with redirect_stderr(errors), redirect_stdout(io.StringIO()):
        try:
            code = command(arguments)
        except SystemExit as end:
            code = end.code or 0
    return code, [line for line in errors.getvalue().splitlines() if not line.startswith("note:")]


def assert_refused(code, lines):
    assert code == 2, (code, lines)
    assert len(lines) == 1 and "error: " in lines[0], lines
    assert len(lines[0]) > 40 and "Traceback" not in lines[0]


@EXAMPLES
@given(st.sampled_from(sorted(COMMANDS)), st.lists(WORDS, max_size=6))
def test_words_of_the_commands(tmp_path, monkeypatch, name, words):
    monkeypatch.chdir(tmp_path)
    # A path that does not exist: whatever the words are, there is nothing to do
    assert_refused(*outcome(main, [name, *words, "--no-such-flag"]))
    assert list(tmp_path.iterdir()) == []


@EXAMPLES
@given(st.text(max_size=10), st.text(max_size=10), st.sampled_from(["evaluate", "enjoy", "diagnose", "saliency"]))
def test_models_and_environments_that_do_not_exist(tmp_path, monkeypatch, model, env, name):
    monkeypatch.chdir(tmp_path)
    output = ["-o", "out.gif" if name == "enjoy" else "out.png"] if name in ("enjoy", "saliency") else []
    assert_refused(*outcome(main, [name, f"--model=./{model}.zip", f"--env={env}!", *output]))
    assert list(tmp_path.iterdir()) == []


@EXAMPLES
@given(
    st.sampled_from(["sac_por", "sac"]),
    st.sampled_from(["por_coef", "gamma", "tau", "learning_rate", "batch_size", "k", "pairing", "random_k", "buffer_size"]),
    st.sampled_from(["x", "'fast'", "-1", "[1]", "{}", "None", "1e400", "nan", "()", "print"]),
)
def test_settings_of_training(tmp_path, monkeypatch, algo, name, value):
    """Of our algorithms and of SB3's, which has some of the names."""
    allowed = {("random_k", "None"), ("learning_rate", "print")}
    monkeypatch.chdir(tmp_path)
    logs = tmp_path / uuid.uuid4().hex
    of_task = {"sac_por": ["FallingBall-v0", "--env-kwargs", "image_size:36"], "sac": ["Pendulum-v1"]}[algo]
    words = ["--algo", algo, "-n", "1", "-f", str(logs), "--env", *of_task]
    monkeypatch.setattr("sys.argv", ["train.py"])
    code, lines = outcome(train, [*words, "-params", f"{name}:{value}"])
    if (name, value) not in allowed:
        assert_refused(code, lines[-1:])
        assert not list(logs.rglob("*.zip"))


@EXAMPLES
@given(
    st.one_of(
        st.text(max_size=60), st.dictionaries(st.sampled_from(["algos", "envs", "seeds", "n_timesteps", "x"]), st.integers())
    )
)
def test_suite_files(tmp_path, content):
    file = tmp_path / "suite.yml"
    file.write_text(content if isinstance(content, str) else "\n".join(f"{key}: {value}" for key, value in content.items()))
    with pytest.raises(UserError) as error:
        read_suite(file)
    assert "\n" not in str(error.value) and "suite.yml" in str(error.value)


@EXAMPLES
@given(st.one_of(st.binary(max_size=80), st.text(alphabet="env,algosdtp\n0123456789.", max_size=80).map(str.encode)))
def test_score_tables(tmp_path, monkeypatch, content):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scores.csv").write_bytes(content)
    assert_refused(*outcome(main, ["plot", "scores.csv", "-o", "curve.png"]))
    assert [path.name for path in tmp_path.iterdir()] == ["scores.csv"]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "model.zip"
    policy = dict(net_arch=[4], features_extractor_kwargs=dict(n_filters=2, strides=(2, 2)))
    SACPOR("CnnPolicy", DotEnv(size=20), buffer_size=10, policy_kwargs=policy, device="cpu").save(path)
    return path.read_bytes()


@EXAMPLES
@given(st.data())
def test_damaged_models(model, tmp_path, data):
    """Truncated, without one of its members, or with one that is cut."""
    file = tmp_path / "model.zip"
    if data.draw(st.booleans()):
        file.write_bytes(model[: data.draw(st.integers(0, len(model) - 1))])
    else:
        with zipfile.ZipFile(io.BytesIO(model)) as whole, zipfile.ZipFile(file, "w") as part:
            members = [name for name in whole.namelist() if name == "data" or name.endswith(".pth")]
            lost = data.draw(st.sampled_from(["data", "policy.pth", None]))
            cut = data.draw(st.sampled_from(members)) if lost is None else None
            for name in whole.namelist():
                content = whole.read(name)
                if name != lost:
                    part.writestr(name, content[: data.draw(st.integers(0, len(content) // 2))] if name == cut else content)
    assert_refused(*outcome(main, ["evaluate", "--model", str(file), "--env", "FallingBall-v0"]))


@EXAMPLES
@given(
    st.sampled_from(["obs_type", "image_size", "split", "renderer", "render_mode", "render_size"]),
    st.one_of(
        st.text(max_size=5), st.integers(max_value=0), st.integers(min_value=4097), st.floats(), st.none(), st.just([1])
    ),
)
def test_constructor_arguments(name, value):
    # Hypothesis also draws words of the source, which may be right
    right = {"obs_type": OBS_TYPES, "split": SPLITS, "renderer": RENDERERS, "render_mode": (None, "rgb_array", "human")}
    assume(isinstance(value, list) or value not in right.get(name, ()))
    with pytest.raises((ValueError, TypeError)) as error:
        FallingBallEnv(**{name: value})
    assert name in str(error.value)


@EXAMPLES
@given(st.one_of(st.just(np.nan), st.just(np.inf), st.integers(0, 5).map(lambda n: np.zeros((2, n))), st.text(max_size=3)))
def test_actions(action):
    env = FallingBallEnv(obs_type="state")
    env.reset(seed=0)
    before = env.state()
    wrong = np.full(env.action_space.shape, action) if isinstance(action, float) else action
    with pytest.raises((ValueError, TypeError)):
        env.step(wrong)
    assert np.array_equal(env.state(), before)
    env.close()
