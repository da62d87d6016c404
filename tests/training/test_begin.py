"""How a run begins: its folder, the model that it begins with, what its evaluation observes."""

import pickle

from sb3_por.training.experiment import Experiment
from sb3_por.training.zoo import main


def test_a_folder_may_have_brackets_in_its_name(tmp_path):
    numbers = []
    for _ in range(2):
        experiment = Experiment.__new__(Experiment)
        experiment.log_path, experiment.env_name, experiment._uuid = str(tmp_path / "logs[1]"), "E-v0", ""
        experiment.tensorboard_log, experiment.optimize_hyperparameters, experiment._resumed_run = None, False, None
        experiment.trained_agent = ""
        experiment.create_log_folder()
        numbers.append(experiment.save_path[-1])
    assert numbers == ["1", "2"]


def test_evaluation_must_observe_what_training_does(tmp_path, capsys):
    flags = [
        "--algo",
        "sac_drq",
        "--env",
        "FallingBall-v0",
        "-n",
        "20",
        "-f",
        str(tmp_path),
        "--eval-env-kwargs",
        "image_size:48",
    ]
    assert main(flags) == 2
    assert "--eval-env-kwargs: evaluation observes Box(0, 255, (3, 48, 48), uint8), and training" in capsys.readouterr().err
    assert not list((tmp_path / "sac_drq").iterdir())


def test_the_best_model_begins_with_the_best_models_statistics(tmp_path, capsys):
    flags = ["--algo", "sac", "--env", "Pendulum-v1", "--eval-episodes", "1", "--seed", "0"]
    params = ["-params", "normalize:True", "learning_starts:10", "policy_kwargs:dict(net_arch=[8])"]
    assert main([*flags, "-n", "40", "--eval-freq", "20", "-f", str(tmp_path / "first"), *params]) == 0
    run = tmp_path / "first" / "sac" / "Pendulum-v1_1"

    def count(folder, name):
        with open(folder / "Pendulum-v1" / name, "rb") as file:
            return round(pickle.load(file).obs_rms.count)

    best = count(run, "best_vecnormalize.pkl")
    (run / "Pendulum-v1" / "vecnormalize.pkl").unlink()  # as when it was killed
    for start, expected in (("best_model.zip", best + 11), ("Pendulum-v1.zip", 11)):
        folder = tmp_path / start
        assert main([*flags, "-n", "10", "--eval-freq", "-1", "-i", str(run / start), "-f", str(folder), *params]) == 0
        assert count(folder / "sac" / "Pendulum-v1_1", "vecnormalize.pkl") == expected
        noted = "there are no statistics of observations in" in capsys.readouterr().err
        assert noted == (start == "Pendulum-v1.zip")
