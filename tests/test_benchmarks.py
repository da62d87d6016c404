"""The benchmark of the learner compares with the encoder passes that the algorithms really make."""

import importlib.util
from pathlib import Path

import pytest
import torch as th
from torch import nn

PATH = Path(__file__).parent.parent / "benchmarks" / "learner.py"
SPEC = importlib.util.spec_from_file_location("learner_benchmark", PATH)
learner = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(learner)


@pytest.mark.parametrize("name", learner.ALGORITHMS)
def test_the_floor_has_the_passes_of_the_algorithm(name, monkeypatch):
    monkeypatch.setattr(learner, "N_FRAMES", 20)
    model = learner.make_model(name, batch=8, image_size=64, device="cpu", options={})
    passes = {"forward": 0, "back": 0}

    def count(conv, inputs, output):
        passes["forward"] += len(output)
        if output.requires_grad:
            output.register_hook(arrive)

    def arrive(gradient):
        passes["back"] += len(gradient)

    first_layers = {id(module): module for module in model.policy.modules() if isinstance(module, nn.Conv2d)}
    for conv in first_layers.values():
        if conv.in_channels == 3:
            conv.register_forward_hook(count)
    # Not an update of which the actor or the targets make nothing, and none with diagnostics
    model._n_updates = 1
    th.manual_seed(0)
    model.train(1, 8)
    trained, untrained, again = learner.ALGORITHMS[name][2]
    assert (passes["forward"] / 8, passes["back"] / 8) == (trained + untrained, trained + again)
