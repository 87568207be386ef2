"""PlanRevision: what training adds to the plan of its run: parts found unneeded, savings measured, the cost it had."""

from __future__ import annotations

import statistics
from collections import deque
from typing import Final

from graings.plan.decision import Component, Decision, Saving
from graings.plan.plan import Plan
from graings.plan.rules import QUIET_GROWTHS
from graings.plan.tile_change import HALF_LEVEL
from graings.report.events import Event, Grew, GrowthCapped, GrowthQuiet, PartDropped
from graings.storage.files import write_document
from graings.storage.run_folder import PLAN_FILE
from graings.training.residual_bound import residual_bound
from graings.training.step_report import StepReport
from graings.training.trainer import Trainer
from graings.training.training_log import TrainingLog

# Steps before and after a part is left out whose CPU time is compared.
COMPARED_STEPS: Final = 50
MIN_COMPARED_STEPS: Final = 10


class PlanRevision:
    """The plan in the `log` of a run, revised while it trains.

    A residual is left out once two evaluations in a row find that it changes no training view by half a grey level.
    What the next decision depends on is in the log, which is part of a checkpoint. The `log` has the plan of the start.
    """

    def __init__(self, log: TrainingLog) -> None:
        self.log = log
        self._planned = log.plan
        self._recent: deque[float] = deque(maxlen=COMPARED_STEPS)  # CPU seconds of the last joint steps
        self._before: float | None = None  # CPU seconds of a step before the residual was left out

    def note(self, step: StepReport) -> None:
        """Take in what a step did and cost."""
        if step.phase == "joint":
            self._recent.append(step.cpu_s)
        for event in step.events:
            if isinstance(event, GrowthQuiet):
                self._note_growth(event)
            if isinstance(event, Grew | GrowthCapped) and self._planned_again("growth"):
                self._write_timed()

    def return_to(self, trainer: Trainer) -> None:
        """Training went back to an earlier scene: what it has left out since then is there again, and in the plan."""
        there: dict[Component, bool] = {
            "residual": trainer.scene.residual is not None,
            "growth": trainer.quiet_growths < QUIET_GROWTHS,
        }
        for component, present in there.items():
            if present and self._planned_again(component) and component == "residual":
                self.log.residual_unseen, self._before = 0, None
        self._write_timed()

    def _planned_again(self, component: Component) -> bool:
        """Take back what training has decided about a component; whether there was anything."""
        planned, decision = self._planned.decision(component), self.plan.decision(component)
        if planned is None or decision is None or decision.decision == planned.decision:
            return False
        self.log.plan = self.plan.revised(planned)
        return True

    def begin_again(self) -> None:
        """Training starts again: what it has found was about the scene before."""
        self.log.plan = self._planned
        self.log.residual_unseen = 0
        self._recent.clear()
        self._before = None
        self.write()

    @property
    def plan(self) -> Plan:
        """The plan as it is now."""
        return self.log.plan

    def revise(self, trainer: Trainer, iteration: int) -> tuple[Event, ...]:
        """After an evaluation: leave the residual out if it does nothing. Returns what happened."""
        with self.log.clock.timed("evaluation"):
            events = self._judge_residual(trainer, iteration)
            self.log.note(events)
            if events:
                self.write()
        return events

    def _judge_residual(self, trainer: Trainer, iteration: int) -> tuple[Event, ...]:
        decision = self._planned.decision("residual")
        if decision is None or decision.kind != "bounded" or trainer.scene.residual is None:
            return ()
        if trainer.iteration < (decision.iteration or 0):
            return ()  # it begins at zero, and the warm-up does not train it
        if trainer.iteration > trainer.config.scaled(trainer.config.average_from):
            return ()  # the trained model is the mean of these steps, in which no part may change
        bound = residual_bound(trainer.scene, trainer.capture.train, trainer.background, HALF_LEVEL)
        self.log.residual_unseen = self.log.residual_unseen + 1 if bound <= HALF_LEVEL else 0
        drop = self.log.residual_unseen >= 2
        self._record(decision, bound, iteration if drop else None)
        if not drop:
            return ()
        self._before = statistics.median(self._recent) if len(self._recent) >= MIN_COMPARED_STEPS else None
        self._recent.clear()
        trainer.drop_residual()
        return (PartDropped(iteration=iteration, component="residual", bound=bound),)

    def finish(self, iterations: int, view_loss: float | None) -> None:
        """After all `iterations`: the prediction's error, what leaving the residual out saved, and view dependence.

        `view_loss` is that of `graings.training.view_dependence`, in dB.
        """
        plan = _with_view_loss(self.plan, view_loss)
        if plan.prediction is not None:
            # A restart repeats steps that no statistic of the capture foresees: it counts as part of the error.
            prediction = plan.prediction.compared(self.log.clock.train_cpu_s)
            plan = plan.model_copy(update={"prediction": prediction})
        decision = plan.decision("residual")
        before, enough = self._before, len(self._recent) >= MIN_COMPARED_STEPS
        if decision is not None and decision.iteration is not None and before is not None and enough:
            saved = (iterations - decision.iteration) * (before - statistics.median(self._recent))
            saving = decision.saving or Saving(predicted_s=None, predicted_share=None)
            measured = saving.model_copy(update={"measured_s": saved})
            plan = plan.revised(decision.model_copy(update={"saving": measured}))
        self.log.plan = plan
        self.write()

    def write(self) -> None:
        """Write plan.json in the run's folder."""
        write_document(self.log.folder / PLAN_FILE, self.plan)

    def _record(self, decision: Decision, bound: float, iteration: int | None) -> None:
        assert decision.condition is not None
        condition = decision.condition.model_copy(update={"value": 255 * bound})
        update: dict[str, object] = {"condition": condition}
        if iteration is not None:
            assert decision.bound is not None
            update |= {
                "decision": "drop",
                "iteration": iteration,
                "bound": decision.bound.model_copy(update={"value": bound}),
                "reason": "it changed no training view by half a grey level at two evaluations",
            }
        self.log.plan = self.plan.revised(decision.model_copy(update=update))

    def _note_growth(self, event: GrowthQuiet) -> None:
        decision = self.plan.decision("growth")
        if decision is None or decision.condition is None:
            return
        condition = decision.condition.model_copy(update={"value": float(event.growths)})
        update = {
            "decision": "drop" if event.ended else "propose",
            "iteration": event.iteration,
            "condition": condition,
            "reason": f"the {event.growths} growths up to this iteration added no anchor",
        }
        self.log.plan = self.plan.revised(decision.model_copy(update=update))
        self._write_timed()

    def _write_timed(self) -> None:
        with self.log.clock.timed("report"):
            self.write()


def _with_view_loss(plan: Plan, loss: float | None) -> Plan:
    """The plan with the measured view dependence; where there is none, the next training may do without."""
    decision = plan.decision("view_dependence")
    if loss is None or decision is None or decision.condition is None:
        return plan
    condition = decision.condition.model_copy(update={"value": loss})
    update: dict[str, object] = {"condition": condition}
    if condition.holds:
        reason = "the trained model hardly uses the viewing direction: another training may do without"
        update |= {"decision": "propose", "reason": reason}
    return plan.revised(decision.model_copy(update=update))
