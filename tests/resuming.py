"""Fits that are stopped and go on, for tests of what a checkpoint holds."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from drgs.train import Trainer, fit

__all__ = ["stopped_and_resumed"]


def stopped_and_resumed(dataset: Callable, run, settings, at: int) -> None:
    """A fit that is killed before the step `at`, and resumed, as another process would, with the data set read anew."""
    step = Trainer.step

    def killed(self):
        if self.step_index == at:
            raise KeyboardInterrupt
        return step(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "step", killed)
        with pytest.raises(KeyboardInterrupt):
            fit(dataset(), run, settings, progress=False)
    fit(dataset(), run, settings, progress=False, resume=True)
