"""Every public name says what it is, and shows it in an example that runs (pytest collects those of magrl/)."""

import doctest
import inspect

import pytest
from test_public_api import modules


def is_written_here(member: object) -> bool:
    """Whether it is a method or a property of ours, not what a parent or a decorator of another library put there."""
    function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
    return inspect.isroutine(function) and (function.__module__ or "").startswith("magrl.")


MODULES = list(modules())
OURS = {
    f"{module.__name__}.{name}": member
    for module in MODULES
    for name, member in vars(module).items()
    if not name.startswith("_")
    and (inspect.isfunction(member) or inspect.isclass(member))
    and member.__module__ == module.__name__
}
MADE_BY = {
    "Elements": "seven_elements",
    "GeomagneticNavGymEnv": "gymnasium.make",
    "GeomagneticNavVectorEnv": "gymnasium.make_vec",
}
"""What a user calls where it is not the name itself."""
METHODS = {
    f"{path}.{name}": (cls, name)
    for path, cls in OURS.items()
    if inspect.isclass(cls)
    for name, member in vars(cls).items()
    if not name.startswith("_") and is_written_here(member)
}


def own_docstring(cls: type, name: str) -> str | None:
    """Of a method, or of the one that it overrides, where that is ours too."""
    family = [parent for parent in cls.__mro__ if parent.__module__.startswith("magrl.")]
    return next((doc for parent in family if (doc := getattr(vars(parent).get(name), "__doc__", None))), None)


def test_names_were_found() -> None:
    assert {"magrl.geodesy.move", "magrl.env.GeomagneticNavEnv", "magrl.runs.locked"} <= OURS.keys()
    assert {"magrl.env.GeomagneticNavEnv.render", "magrl.navigators.Navigator.field_readings"} <= METHODS.keys()


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.__name__)
def test_modules_say_what_they_are(module) -> None:
    assert (module.__doc__ or "").strip()


@pytest.mark.parametrize("path", OURS)
def test_public_names_have_an_example(path: str) -> None:
    examples = doctest.DocTestParser().get_examples(inspect.getdoc(OURS[path]) or "")
    assert examples, f"{path} has no example in its docstring"
    name = path.rpartition(".")[2]
    assert any(MADE_BY.get(name, name) in example.source for example in examples), f"the example does not use {name}"


@pytest.mark.parametrize("path", METHODS)
def test_public_methods_have_a_docstring(path: str) -> None:
    assert own_docstring(*METHODS[path]), f"{path} has no docstring"
