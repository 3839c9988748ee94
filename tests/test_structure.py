"""The rooms: no module imports itself in a circle, and imports only point down."""

import ast
import subprocess
import sys
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "jaxpend"
# From the bottom up. A name stands for the modules in it that are not named apart. Modules of one
# line may import each other, as long as there is no circle.
LAYERS = """
errors files arrays robots pytree fields trigonometry observation config config_files terminal
hosts
devices
plant
designs resets
scenario
variations hardware
stepping
controller
rollout
criteria
task
boards
score sweep identification
robustness fleet
trajopt
controllers
trajopt.search leaderboard
stage retention
env
sac
snes gradient shac openings
runs
train
report
interop
cli
"""
RANK = {name: rank for rank, line in enumerate(LAYERS.split("\n")) for name in line.split()}


def module_name(path):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def is_for_people_who_run_it(node):
    """``if TYPE_CHECKING:`` and ``if __name__ == "__main__":``: nobody who imports it runs that."""
    return isinstance(node, ast.If) and any(
        name in ast.dump(node.test) for name in ("TYPE_CHECKING", "__main__")
    )


def imported(name):
    """Modules of the package that a module imports, also inside functions."""
    path, found = MODULES[name], set()
    here = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    waiting = [ast.parse(path.read_text())]
    while waiting:
        node = waiting.pop()
        if is_for_people_who_run_it(node):
            waiting += node.orelse
            continue
        waiting += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else []
            base = ".".join([*base, *([node.module] if node.module else [])])
            found |= {base} | {f"{base}.{alias.name}" for alias in node.names}
    # What is in a package runs its __init__ first.
    found |= {module.rpartition(".")[0] for module in found}
    own = {name, *(name.rsplit(".", k)[0] for k in range(1, name.count(".") + 1))}
    return {module for module in found if module in MODULES and module not in own | {"jaxpend"}}


GRAPH = {name: imported(name) for name in MODULES}


def rank(name):
    """Where a module stands; the most exact name counts."""
    parts = name.split(".")[1:]
    known = (".".join(parts[:k]) for k in range(len(parts), 0, -1))
    return next(RANK[part] for part in known if part in RANK)


def test_every_module_has_a_place():
    homeless = {
        name
        for name in MODULES
        if name != "jaxpend"
        and not name.endswith(".__main__")
        and not any(".".join(name.split(".")[1:k]) in RANK for k in range(2, 6))
    }
    assert not homeless


def test_imports_point_down():
    climbs = [
        f"{name} imports {other}"
        for name, others in GRAPH.items()
        if name != "jaxpend" and not name.endswith(".__main__")
        for other in others
        if rank(other) > rank(name)
    ]
    assert not climbs


def test_there_is_no_circle():
    done, path = set(), []

    def visit(name):
        assert name not in path, " -> ".join([*path[path.index(name) :], name])
        if name not in done:
            path.append(name)
            for other in sorted(GRAPH[name]):
                visit(other)
            done.add(path.pop())

    for name in MODULES:
        visit(name)


def test_files_and_functions_are_short():
    long = []
    for name, path in MODULES.items():
        text = path.read_text()
        if text.count("\n") > 400:
            long.append(name)
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef) and node.end_lineno - node.lineno > 60:
                long.append(f"{name}.{node.name}")
    assert not long


def test_all_says_what_there_is():
    """Every name in ``__all__`` is there, and what other modules import by name is in it."""
    missing = []
    for name, path in MODULES.items():
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.ImportFrom) or not node.level or not node.module:
                continue
            here = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
            base = ".".join([*here[: len(here) - node.level + 1], node.module])
            if base not in MODULES:
                continue
            said = public(base)
            missing += [
                f"{name} imports {alias.name} of {base}"
                for alias in node.names
                if said is not None
                and alias.name not in said
                and f"{base}.{alias.name}" not in MODULES
            ]
    assert not missing


def public(name):
    """What a module says in ``__all__``; None: it says nothing."""
    for node in ast.parse(MODULES[name].read_text()).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            return ast.literal_eval(node.value)
    return None


def test_a_module_that_shares_its_name_with_a_function_is_both():
    code = "import jaxpend.rollout as module; from jaxpend import rollout; import jaxpend.score; "
    code += "assert module is rollout and module.rollout is jaxpend.score.rollout; "
    code += "assert callable(rollout) and rollout.Trajectory"
    subprocess.run([sys.executable, "-c", code], check=True)
