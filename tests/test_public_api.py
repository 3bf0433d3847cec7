"""Every public function, class and method refuses bad arguments, with the value in the message.

``ROWS`` holds the bad calls of each public name (``rows_physics.py``, ``rows_learning.py``). A name without a row, or
without a reason in ``EXEMPT``, fails the suite. Where NaN in means NaN out by design, the row proves that.
"""

from __future__ import annotations

import pytest
import rows_learning
import rows_physics
import torch
from public_names import public_names
from refusals import NAN, zeros

from magrl import geodesy, guidance
from magrl.envs import PAPER_REGION

ROWS = rows_physics.ROWS | rows_learning.ROWS

EXEMPT = {
    "checks.CheckedModel": "a base class: the rows of Scenario and RunConfig cover it",
    "checks.CheckedModel.replace": "calls the constructor of the subclass",
    "checks.short": "formats any value",
    "files.DamagedFileError": "an error",
    "files.json_ready": "passes on any value; write_json raises for what JSON lacks",
    "field.FieldModel": "a protocol",
    "field.FieldModel.value_and_gradient": "of a protocol",
    "envs.Tasks": "a named tuple, which Scenario checks",
    "envs.Scenario.floors": "takes any field model",
    "navigators.Navigator.first_memory": "of a subclass, called by forward",
    "navigators.Navigator.decide": "of a subclass, called by forward",
    "navigators.metaheuristics.Metaheuristic.begin": "of a subclass, called by first_state",
    "navigators.metaheuristics.Metaheuristic.evolve": "of a subclass, called by decide",
    "navigators.metaheuristics.Metaheuristic.uniform": "draws in the shape that the algorithm asks for",
    "navigators.metaheuristics.Metaheuristic.normal": "draws in the shape that the algorithm asks for",
    "navigators.metaheuristics.Metaheuristic.first_state": "called by first_memory and decide",
    "agents.PolicyConfig.make_actor": "takes a device, which torch checks",
    "agents.SoftUpdate": "TorchRL's, which checks its arguments",
    "agents.first_state": "takes no arguments",
    "onboard.Command": "holds what a step returns",
    "agents.optimize": "takes a loss and optimizers of torch",
    "agents.recurrent_transforms": "takes a view and an actor, which are checked where they are made",
    "training.UsageError": "an error",
    "training.command": "calls the function that it is given",
    "training.Run.evaluation_envs": "passes its options to the environment, which checks them",
    "training.Run.start": "takes the parts of a training, which are checked where they are made",
    "training.Run.finish": "takes an environment; tests/test_recipes.py runs it",
    "training.RunConfig.linear": "takes the name of a field of a recipe's settings",
}


def test_every_public_name_has_a_row_or_a_reason() -> None:
    names = set(public_names())
    assert not ROWS.keys() & EXEMPT.keys()
    assert names - ROWS.keys() - EXEMPT.keys() == set(), "add bad calls of these to ROWS"
    assert ROWS.keys() - names == set(), "these do not exist"
    assert EXEMPT.keys() - names == set(), "these do not exist"
    assert all(ROWS.values())
    assert all(len(reason) > 5 for reason in EXEMPT.values())


@pytest.mark.parametrize("name", ROWS)
def test_bad_arguments_are_refused_by_value(name: str) -> None:
    failures = {index: failure for index, row in enumerate(ROWS[name]) if (failure := row.failure())}
    assert not failures


def test_parallel_approach_masks_nan() -> None:
    """The one function of a step whose result for NaN is not NaN: heading 0, and a mask that is False."""
    good = [zeros(2), torch.ones(2), torch.eye(2)]
    assert guidance.parallel_approach(*good)[1].all()
    for place in range(3):
        bad = [x * NAN if k == place else x for k, x in enumerate(good)]
        heading, valid = guidance.parallel_approach(*bad)
        assert heading.eq(0).all()
        assert not valid.any()


def test_nan_is_in_no_region() -> None:
    assert not PAPER_REGION.contains(torch.tensor([[NAN, 165.0], [-5.0, NAN], [NAN, NAN]])).any()


def test_a_latitude_beyond_the_pole_continues_over_it() -> None:
    over, down = ((100.0, 0.0), (80.0, 180.0))
    ends = [geodesy.to_ecef(*(torch.tensor(x, dtype=torch.float64) for x in place)) for place in (over, down)]
    torch.testing.assert_close(*ends)
