"""What a user gets with `pip install`: of this tree, or the wheel in an environment that has never seen it."""

import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

import magrl

ROOT = Path(__file__).parent.parent.parent
TOUR = """
import sys
from importlib.metadata import version
from pathlib import Path

import magrl

assert "torch" not in sys.modules
import torchrl.envs, torchrl.modules, torchrl.objectives

theirs = set(sys.modules)
from magrl import envs, errors, field, navigators, transforms

assert not {"matplotlib", "pandas", "wandb", "tqdm", "tyro"} & (set(sys.modules) - theirs), "imports are not light"
import gymnasium

assert magrl.evaluate("anywhere", "paper-example")["success"].all()
assert gymnasium.make("magrl/GeomagneticNavigation-v1").reset(seed=0)[0].shape == (13,)

from magrl.evaluation import maps

assert Path(magrl.__file__).is_relative_to(sys.prefix), magrl.__file__
assert version("magrl") == magrl.__version__, (version("magrl"), magrl.__version__)
assert all(getattr(magrl, name) is not None for name in magrl.__all__)

env = magrl.GeomagneticNavEnv(num_envs=4, seed=0)
rollout = magrl.evaluation_rollout(env, navigators.Secant())
print(magrl.summarize(magrl.episode_measures(rollout))["success_rate"])
maps.trajectories_figure(rollout, env.field, env.region).savefig("episodes.png")
"""
MYPY = """
[mypy]
strict = true
cache_dir = {cache}
[mypy-torch.*,torchrl.*,tensordict.*,numpy.*,matplotlib.*,gymnasium.*]
follow_imports = skip
"""


def run(*command: object, cwd: Path) -> str:
    """Return the output of a command that runs without the tree on Python's path."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=environment, capture_output=True, text=True, encoding="utf-8"
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def built(kind: str, folder: Path) -> Path:
    """Return the wheel, editable wheel or sdist of this tree, which the build leaves as it is."""
    build = f"import hatchling.build as backend, sys; backend.build_{kind}(sys.argv[1])"
    run(sys.executable, "-c", build, folder, cwd=ROOT)
    (archive,) = folder.glob("magrl-*")
    return archive


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    return built("wheel", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory) -> Path:
    """Return Python of an environment with the wheel, which finds all else where the present environment has it."""
    folder = tmp_path_factory.mktemp("user")
    venv.create(folder / "venv", with_pip=False)
    executable = folder / "venv" / "bin" / "python"
    site = Path(run(executable, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder).strip())
    # A path in a .pth file is searched last, and .pth files that lie there (such as this tree's own) are not read.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    options = ("--no-deps", "--no-index", "--disable-pip-version-check")
    run(sys.executable, "-m", "pip", "--python", executable, "install", *options, wheel, cwd=folder)
    return executable


def files_of(*folders: str) -> set[str]:
    """Return the files in some folders of this tree, by their path in it, without those that runs and tools leave."""
    files = [path.relative_to(ROOT) for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file()]
    left = re.compile(r"(^|/)(\.|__pycache__/|runs/|wandb/)")
    return {str(path) for path in files if not left.search(str(path))}


def test_wheel_holds_the_library_its_licenses_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
    about = f"magrl-{magrl.__version__}.dist-info"
    assert {name for name in held if not name.startswith(about)} == files_of("magrl")
    assert {f"{about}/licenses/LICENSE", f"{about}/licenses/NOTICE"} <= held


def test_the_notice_names_the_data_of_others() -> None:
    """All data of the library but its own: policies, and the errors of sensors, which are chosen."""
    data = {name for name in files_of("magrl") if not name.endswith((".py", ".pyi", ".toml", "py.typed"))}
    notice = re.findall(r"^magrl/\S+", (ROOT / "NOTICE").read_text(encoding="utf-8"), re.MULTILINE)
    assert {name for name in data if "/pretrained/" not in name} == set(notice)


def test_sdist_holds_what_the_tests_need(tmp_path: Path) -> None:
    with tarfile.open(built("sdist", tmp_path)) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    assert files_of("magrl", "recipes", "tests", "docs", "benchmarks") <= held
    assert {"LICENSE", "NOTICE", "Makefile", "conftest.py", "constraints.txt", "pyproject.toml", "README.md"} <= held


def test_editable_install_is_found_beside_a_folder_of_the_same_name(tmp_path: Path) -> None:
    """As in the folder above a clone: Python takes it for a namespace package if no path holds the library."""
    with zipfile.ZipFile(built("editable", tmp_path)) as archive:
        archive.extractall(tmp_path / "site")
    (tmp_path / "magrl").mkdir()
    find = "import importlib.util as i, site; site.addsitedir('site'); print(i.find_spec('magrl').origin)"
    assert run(sys.executable, "-S", "-c", find, cwd=tmp_path).strip() == str(ROOT / "magrl" / "__init__.py")


def test_the_hook_before_a_commit_has_the_version_of_ruff() -> None:
    (version,) = re.findall(r"^ruff==(.*)", (ROOT / "constraints.txt").read_text(encoding="utf-8"), re.MULTILINE)
    assert f"rev: v{version} " in (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")


@pytest.mark.slow
def test_wheel_works_without_the_tree(python: Path, tmp_path: Path) -> None:
    assert len(run(python, "-c", TOUR, cwd=tmp_path).splitlines()) == 1
    assert (tmp_path / "episodes.png").stat().st_size > 10_000


@pytest.mark.slow
def test_user_s_code_is_typed(python: Path, tmp_path: Path) -> None:
    """Under mypy --strict: a script that is right passes, one that is wrong does not, and no public name is Any."""
    (tmp_path / "mypy.ini").write_text(MYPY.format(cache=tmp_path / "cache"), encoding="utf-8")
    right = "import magrl\nrate: float = magrl.summarize(magrl.evaluate('secant', 'paper-example'))['success_rate']\n"
    right += "".join(f"reveal_type(magrl.{name})\n" for name in magrl.__all__)
    (tmp_path / "user.py").write_text(right, encoding="utf-8")
    check = (sys.executable, "-m", "mypy", "--config-file", "mypy.ini", "--python-executable", python)
    said = run(*check, "user.py", cwd=tmp_path)
    assert said.count("Revealed type is") == len(magrl.__all__)
    assert 'Revealed type is "Any"' not in said, said
    wrong = "import magrl\nmagrl.GeomagneticNavEnv(num_envs='four')\n"
    assert "arg-type" in subprocess.run([*check, "-c", wrong], cwd=tmp_path, capture_output=True, text=True).stdout
