"""What a stage of training is: a typed state that moves on in chunks and is judged in between.

A stage is one class. It says all that others need to know of it: how far it goes, what counts,
its charts and its headings (``Stage.about``). A run writes that into its folder, where the list
of runs, the report and TensorBoard read it. All that a stage needs to go on is in its state, so
that a checkpoint of the state is a checkpoint of the stage. Chunks do not depend on time, only on
the configuration.
"""

from functools import partial
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from . import devices
from .config import Objective, Run
from .controller import Controller
from .controllers.search_space import kinds
from .pytree import Pytree, pytree
from .score import combined, imperfect, nominal
from .task import Task

__all__ = [
    "Candidates", "Chart", "Row", "SearchStage", "SearchState", "Stage", "ranked", "standing",
    "value",
]  # fmt: skip

Row = dict[str, Any]  # of metrics
Candidates = list[tuple[Controller, float]]  # with their scores

Before = TypeVar("Before", contravariant=True)  # what a stage starts from
State = TypeVar("State")  # what it changes, a pytree
After = TypeVar("After", covariant=True)  # what the next stage starts from


class Chart(NamedTuple):
    """A learning curve of a stage; what counts is on x."""

    title: str
    curves: dict[str, str]  # label -> column of the metrics; "best" is the best score so far
    ylabel: str = ""
    log: bool = False


class Stage(Protocol[Before, State, After]):
    """What the stages share; every method is pure."""

    name: ClassVar[str]  # in metrics, file names and results
    title: ClassVar[str]  # for people
    unit: ClassVar[str]  # what ``done`` counts
    column: ClassVar[str]  # the same in the metrics
    heading: ClassVar[str] = ""  # of its official score; empty: it makes no controllers
    charts: ClassVar[tuple[Chart, ...]] = ()
    scores: ClassVar[tuple[str, ...]] = ()  # columns of the metrics with official scores
    ties: ClassVar[bool] = False  # whether a policy as good as the best replaces it

    task: Task  # on which ``compared`` scores
    total: int
    objective: Objective = Objective()  # what candidates are compared by, see ``value``

    @classmethod
    def of(cls, run: Run, start: Controller | None, task: Task) -> "Stage | None":
        """The stage that a configuration has; None: it has no such stage.

        ``start`` is a controller of the structure that the stage before ends with.
        """
        return None

    def about(self) -> dict[str, Any]:
        """What others need to know of it, as plain values."""
        names = ("name", "title", "unit", "column", "total", "heading", "charts", "scores")
        return {name: getattr(self, name) for name in names}

    def start(self, seed: int, before: Before) -> State:
        """The state before the first chunk; ``before`` is the ``outcome`` of the last stage."""

    def like(self) -> State:
        """A state without numbers: the structure that checkpoints are read into."""

    def policy_like(self) -> Controller | None:
        """The same of a controller that it makes; None: it makes none."""
        return None

    def done(self, state: State) -> int:
        """How much of ``total`` is done."""

    def advance(self, states: list[State]) -> list[tuple[State, Row]]:
        """The next chunk of one run, or of several at the same step; states and metrics."""

    def judge(self, state: State, metrics: Row) -> tuple[Row, Candidates]:
        """A row of metrics, and controllers with their scores, the last one of training first."""

    def compared(self, controller: Controller) -> tuple[float, float]:
        """The official score of a candidate, and what it is compared by."""
        score = float(self.task.score(nominal(controller, self.task)).mean())
        return score, value(self.objective, controller, score, self.task)

    def note(self, row: Row) -> str:
        """What a row of metrics says, for people."""

    def watched(self, state: State) -> Any:
        """What has to be finite, besides the metrics."""

    def rekey(self, state: State, number: int) -> State:
        """The same state, to go on from with other random numbers."""

    def outcome(self, state: State, best: Any) -> After:
        """What the next stage starts from: the best controller."""
        return best


def ranked(worths: Any) -> list[int]:
    """The numbers of several controllers, the one that is worth most first; as they were if even.

    ``worths`` (n,) are what they are compared by.
    """
    return [int(i) for i in np.argsort(-np.asarray(worths), kind="stable")]


# --- searches on the score -----------------------------------------------------------------

# Of the scenarios on which candidates are compared: no seed of a run, and no key of the benchmark.
VALIDATION_SEED = 2**31 - 1
# Of those in which people are told how often the result stands, and how many there are.
STANDING_SEED, STANDING = 2**31 - 2, 1024


@partial(jax.jit, static_argnames=("objective", "task"))
def _validated(objective: Objective, controller: Controller, score: float, task: Task) -> jax.Array:
    met = imperfect(controller, task, jax.random.key(VALIDATION_SEED), objective.validation)
    return combined(objective, jnp.asarray(score), met, task)


def value(objective: Objective, controller: Controller, score: float, task: Task) -> float:
    """What candidates are compared by, given their official score.

    It is the score itself; of an objective that weighs scenarios it is ``score.combined`` on
    ``objective.validation`` of them, which stay the same.
    """
    if not objective.weight:
        return score
    found = devices.compute(lambda c, s: _validated(objective, c, s, task), controller, score)
    return float(found)


@partial(jax.jit, static_argnames="task")
def _standing(controller: Controller, task: Task) -> jax.Array:
    return imperfect(controller, task, jax.random.key(STANDING_SEED), STANDING)[1].mean()


def standing(controller: Controller, task: Task) -> float:
    """The share of random imperfect scenarios in which a controller ends upright.

    They stay the same, and are others than those that candidates are compared on.
    """
    return float(devices.compute(lambda c: _standing(c, task), controller))


@pytree
class SearchState(Pytree):
    """A search on a controller's parameters."""

    start: Controller  # the origin of the coordinates, and all that is not searched
    search: Any  # GradientState or SNESState
    done: jax.Array  # () int, steps or generations
    fresh: jax.Array | None = None  # key of the noise that only judges, where there is such


class SearchStage(Stage[Controller, SearchState, Controller]):
    """What the gradient and SNES share: they go on from a controller, and end with the best."""

    def __init__(self, config: Any, policy: Any, task: Task):
        """``policy`` is a controller of the structure that is searched.

        Raises ``JaxpendError`` if it has nothing to search.
        """
        kinds(policy, config.searched)
        self.config, self.policy, self.task = config, policy, task
        self.objective = config.objective
        self.total = getattr(config, self.unit)  # the field is called like what it counts

    def prepared(self, controller: Controller) -> Controller:
        """The controller that is searched, of one to start from."""
        return controller

    def begin(self, seed: int, controller: Controller) -> SearchState:
        """The state before the first chunk, of the controller that is searched."""
        raise NotImplementedError

    def search(self, states: list[SearchState], count: int) -> list[tuple[Any, Row]]:
        """``SearchState.search`` after ``count`` steps, and their metrics (count,)."""
        raise NotImplementedError

    def start(self, seed: int, before: Controller | tuple[Controller, ...]) -> SearchState:
        """Of several controllers, the best first, it goes on from the first."""
        first = before[0] if isinstance(before, tuple) else before
        return self.begin(seed, self.prepared(first))

    def like(self) -> SearchState:
        return jax.eval_shape(partial(self.begin, 0), self.policy)

    def policy_like(self) -> Controller:
        return self.policy

    def done(self, state: SearchState) -> int:
        return int(state.done)

    def advance(self, states: list[SearchState]) -> list[tuple[SearchState, Row]]:
        count = min(self.config.chunk, self.total - self.done(states[0]))
        return [
            (state.replace(search=search, done=state.done + count), metrics)
            for state, (search, metrics) in zip(states, self.search(states, count), strict=True)
        ]

    def rekey(self, state: SearchState, number: int) -> SearchState:
        key = jax.random.fold_in(state.search.key, number)
        return state.replace(search=state.search.replace(key=key))
