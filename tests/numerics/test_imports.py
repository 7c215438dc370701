"""What may not be imported: nothing heavy, before it is needed."""

import os
import resource
import subprocess
import sys

import pytest

HEAVY = {
    *("clarabel", "cvxpy", "jax", "matplotlib", "numba", "numpy", "pint", "pyarrow", "pybullet", "pydantic"),
    *("fmpy", "gymnasium", "mujoco", "pydrake", "rerun", "rich", "ruamel", "scipy", "sympy", "torch"),
}
LIMIT = 0.35  # s of CPU, user and system, whole process


def python(*arguments):
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=os.environ)
    assert done.returncode == 0, done.stderr
    return done.stdout


def loaded_by(statement):
    return set(python("-c", f"import sys\n{statement}\nprint('\\nloaded', *sys.modules)").splitlines()[-1].split())


@pytest.mark.run
@pytest.mark.parametrize(
    "statement",
    [
        "import gapcert",
        "import gapcert; gapcert.Component; gapcert.hookimpl; gapcert.UsageError; dir(gapcert)",
        "import gapcert; gapcert.registry().listing()",
        "from gapcert.cli.main import main; main(['--help'])",
        "from gapcert.cli.main import main; main(['plugins', '--json'])",
        "from gapcert.cli.main import main; main(['plugins'])",
    ],
)
def test_importing_and_listing_load_nothing_heavy(statement):
    assert HEAVY & loaded_by(statement) == set()


@pytest.mark.run
def test_the_check_above_can_fail():
    assert "numpy" in loaded_by("import gapcert; gapcert.Interval")


@pytest.mark.run
def test_the_options_of_all_plugins_are_light():
    assert HEAVY & loaded_by("from gapcert.spec.schema import schema; schema()") == {"pydantic", "ruamel"}


def cpu(*arguments):
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    python(*arguments)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.mark.run
@pytest.mark.parametrize("arguments", [("-c", "import gapcert"), ("-m", "gapcert", "--help"), ("-m", "gapcert", "plugins")])
def test_the_first_answer_is_quick(arguments):
    # The best of some, since a busy machine only adds.
    assert any(cpu(*arguments) <= LIMIT for _ in range(5))
