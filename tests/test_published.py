"""The benchmark's restatement of the published recipe has our losses: it compares cost alone."""

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
import speed  # noqa: E402

from nsm.config import compose_config  # noqa: E402

SMALL = ["seed=0", "data.batch_size=256", "encoding.resolutions=[8,32]"]


@pytest.mark.parametrize("task", speed.TASKS)
def test_the_losses_agree(task, monkeypatch):
    losses, restated = [], []
    recipe = getattr(speed.published, task)
    monkeypatch.setattr(
        torch.Tensor, "backward", lambda self, *_: losses.append(self.detach().double().item())
    )
    monkeypatch.setattr(
        speed.published, task, lambda *given: restated.append(recipe(*given)) or restated[-1]
    )

    def small(task, _):
        network = [] if task == "overfit" else ["experiment=adam"]
        return compose_config([f"task={task}", *network, *SMALL])

    monkeypatch.setattr(speed, "config_of", small)
    for step in speed.task_steps(task, "default", k=3):
        step()
    ours, theirs = losses
    assert ours == pytest.approx(theirs, rel=1e-2)
    assert [loss.item() for loss in restated] == [theirs]  # the other side is the recipe's alone
