"""When a training stops by the norm of its gradient."""

from types import SimpleNamespace

import pytest
from torch import nn, optim, zeros

from nsm.results.callbacks import GradientWatch
from nsm.tasks.schedules import build_scheduler


def stopped(norms, schedule, threshold=1.0, window=3, batch=None, **options):
    """The step after which a training with gradients of these norms stops, or None."""
    weight = nn.Parameter(zeros(1))
    settings = {"_target_": f"nsm.tasks.schedules.{schedule['name']}", **schedule["settings"]}
    scheduler = build_scheduler(optim.SGD([weight], lr=1.0), settings, len(norms))
    watch = GradientWatch(10**6, threshold, window, **options)
    trainer = SimpleNamespace(
        global_step=0,
        should_stop=False,
        world_size=1,
        lr_scheduler_configs=[SimpleNamespace(scheduler=scheduler)],
    )
    for step, norm in enumerate(norms):
        trainer.global_step = step
        weight.grad = zeros(1) + norm
        watch.on_before_optimizer_step(trainer, nn.ParameterList([weight]), None)
        trainer.global_step = step + 1
        watch.on_train_batch_end(trainer, None, None, batch, 0)
        if trainer.should_stop:
            return step + 1
    return None


CONSTANT = {"name": "Constant", "settings": {}}
WAVES = {"name": "SGDR", "settings": {"period": 10, "period_factor": 1.0}}


def test_a_constant_rate_stops_at_once():
    assert stopped([2.0] * 4 + [0.5] * 26, CONSTANT) == 7  # (0.5 + 0.5 + 0.5) / 3, not 2 + ...


def test_warm_restarts_stop_where_a_wave_ends():
    assert stopped([2.0] * 4 + [0.5] * 26, WAVES) == 10
    assert stopped([2.0] * 11 + [0.5] * 19, WAVES) == 20
    assert stopped([2.0] * 30, WAVES) is None


@pytest.mark.parametrize("batch", [zeros(50, 2), (zeros(50, 2), zeros(50, 3))])
def test_the_norm_of_a_sum_is_that_of_the_mean_times_the_samples(batch):
    falling = [0.5, 0.1, 0.03, 0.019, 0.019, 0.019]
    assert stopped(falling, CONSTANT, window=1, batch=batch, summed=True) == 4  # 50 · 0.019 < 1
    assert stopped(falling, CONSTANT, window=1, batch=batch) == 1
