"""Making a solver in a thread: the newest plan wins, a failure is told, and nobody waits."""

import threading
import time

import pytest

from us_sim.errors import SolverError
from us_sim.tissue.solvers.preparation import Failed, Preparation
from us_sim.tissue.solvers.switching import Plan


class SlowTissue:
    """Makes a plan when it is let; what is made is the plan itself."""

    def __init__(self) -> None:
        self.begun: list[str] = []
        self.has_begun = threading.Semaphore(0)
        self.may_end = threading.Semaphore(0)

    def make(self, plan: Plan, progress: object = None, *, beside: bool) -> Plan:  # noqa: ARG002
        self.begun.append(plan.solver)
        self.has_begun.release()
        assert self.may_end.acquire(timeout=20)
        if plan.solver == "impossible":
            raise SolverError("it cannot be")
        if plan.solver == "broken":
            raise ZeroDivisionError("division by zero")
        return plan


@pytest.fixture
def tissue():
    return SlowTissue()


@pytest.fixture
def preparation(tissue):
    return Preparation(tissue)


def outcome_of(preparation):
    """What comes of it in the end."""
    deadline = time.monotonic() + 20
    while (outcome := preparation.take()) is None:
        assert time.monotonic() < deadline
        time.sleep(0.001)
    return outcome


def test_nothing_waits_for_what_is_made_and_it_can_be_taken_once(preparation, tissue):
    assert (preparation.state, preparation.take()) == ("", None)
    plan = Plan("fem")
    preparation.want(plan)
    assert tissue.has_begun.acquire(timeout=20)
    assert preparation.take() is None
    assert preparation.state.endswith(" for 0 s")
    tissue.may_end.release()
    assert outcome_of(preparation) is plan
    assert preparation.take() is None
    assert preparation.state == ""


def test_the_newest_plan_wins_and_those_between_are_never_made(preparation, tissue):
    preparation.want(Plan("first"))
    assert tissue.has_begun.acquire(timeout=20)
    for name in ("second", "third", "newest"):
        preparation.want(Plan(name))
    tissue.may_end.release()
    assert tissue.has_begun.acquire(timeout=20)
    assert preparation.take() is None  # the first is no longer wanted
    tissue.may_end.release()
    assert outcome_of(preparation).solver == "newest"
    assert tissue.begun == ["first", "newest"]


def test_what_was_made_and_not_taken_gives_way_to_a_newer_plan(preparation, tissue):
    preparation.want(Plan("first"))
    tissue.may_end.release()
    deadline = time.monotonic() + 20
    while preparation.state:
        assert time.monotonic() < deadline
        time.sleep(0.001)
    preparation.want(Plan("newest"))
    assert preparation.take() is None
    tissue.may_end.release()
    assert outcome_of(preparation).solver == "newest"


def test_what_is_dropped_is_never_told(preparation, tissue):
    preparation.want(Plan("first"))
    assert tissue.has_begun.acquire(timeout=20)
    preparation.drop()
    assert preparation.state == ""
    tissue.may_end.release()
    preparation.want(Plan("newest"))
    tissue.may_end.release()
    assert outcome_of(preparation).solver == "newest"


@pytest.mark.parametrize(
    ("name", "problem"),
    [("impossible", "it cannot be"), ("broken", "ZeroDivisionError: division by zero")],
)
def test_a_failure_is_told_and_the_next_plan_is_made(preparation, tissue, name, problem):
    plan = Plan(name)
    preparation.want(plan)
    tissue.may_end.release()
    assert outcome_of(preparation) == Failed(plan, problem)
    preparation.want(Plan("fem"))
    tissue.may_end.release()
    assert outcome_of(preparation).solver == "fem"


def test_a_failure_of_a_plan_that_is_no_longer_wanted_is_not_told(preparation, tissue):
    preparation.want(Plan("impossible"))
    assert tissue.has_begun.acquire(timeout=20)
    preparation.want(Plan("fem"))
    tissue.may_end.release(2)
    assert outcome_of(preparation).solver == "fem"
    assert preparation.take() is None
