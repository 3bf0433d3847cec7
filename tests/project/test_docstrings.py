"""Every public name has a docstring with an example that runs (pytest collects the examples of magrl/)."""

import doctest
import importlib
import inspect
import pkgutil

from support import public_names

import magrl

MADE_BY = {"GeomagneticNavGymEnv": "gymnasium.make", "GeomagneticNavVectorEnv": "gymnasium.make_vec"}
"""What a user calls where it is not the name itself."""
MEMBERS = public_names.public_members()


def is_written_here(member: object) -> bool:
    """Whether a member is a method or property of this package, not of a parent or a decorator of another library."""
    function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
    return inspect.isroutine(function) and (function.__module__ or "").startswith("magrl.")


def own_docstring(cls: type, name: str) -> str | None:
    """The docstring of a method, or of the method of this package that it overrides."""
    family = [parent for parent in cls.__mro__ if parent.__module__.startswith("magrl.")]
    return next((doc for parent in family if (doc := getattr(vars(parent).get(name), "__doc__", None))), None)


def uses(docstring: str, name: str) -> bool:
    examples = doctest.DocTestParser().get_examples(docstring)
    return any(MADE_BY.get(name, name) in example.source for example in examples)


def test_names_were_found() -> None:
    assert {"geodesy.move", "envs.gymnasium.GeomagneticNavGymEnv", "training.Run"} <= set(MEMBERS)


def test_every_module_has_a_docstring() -> None:
    modules = [importlib.import_module(found.name) for found in pkgutil.walk_packages(magrl.__path__, "magrl.")]
    assert len(modules) > 40
    assert [module.__name__ for module in modules if not (module.__doc__ or "").strip()] == []


NO_EXAMPLE = {"training.Run"}
"""It takes a training to show these: the recipes are their examples."""


def test_every_public_name_has_an_example_that_uses_it() -> None:
    lacking = {path for path, member in MEMBERS.items() if not uses(inspect.getdoc(member) or "", path.split(".")[-1])}
    assert lacking == NO_EXAMPLE


def test_every_public_method_has_a_docstring() -> None:
    methods = [
        (path, cls, name)
        for path, cls in MEMBERS.items()
        if inspect.isclass(cls)
        for name, member in vars(cls).items()
        if not name.startswith("_") and is_written_here(member)
    ]
    assert ("envs.GeomagneticNavEnv", "render") in [(path, name) for path, _, name in methods]
    assert [f"{path}.{name}" for path, cls, name in methods if not own_docstring(cls, name)] == []
