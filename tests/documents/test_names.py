"""Code names and paths in the documents: every one of them exists."""

from __future__ import annotations

import ast
import re
import subprocess
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/**/*.md"))]
PACKAGES = {
    path.parent.name: path.parent
    for path in (*ROOT.glob("*_pkg/*_pkg/__init__.py"), *ROOT.glob("ros_ws/src/*/*/__init__.py"))
}
FILES = ("md", "json", "jsonl", "yaml", "xml", "toml", "lock", "sh", "gz", "png", "logs")
# Of other projects, of runs' folders, or made of parts.
ELSEWHERE = {
    "pymunk.batch",
    "my_faults/hiccup.py",
    "my_strategies/weakest.py",
    "best/",
    "mlflow.db",
    "policy.pt",
    "publish_time",
    "return_1_crashed",
    "robot_n",
}
SOURCES = ("*.py", "*.yaml", "*.msg", "*.xml", "*.js", "*.toml", "Makefile")

Names = dict[str, set[str]]


@cache
def tracked() -> tuple[str, ...]:
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return tuple(listed.stdout.splitlines())


@cache
def words() -> frozenset[str]:
    """Every identifier of the sources, tests aside: they could name what is no more."""
    listed = subprocess.run(
        ["git", "grep", "-hoIE", r"[A-Za-z_][A-Za-z0-9_]+", "--", *SOURCES, ":!tests/*test_*.py"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return frozenset(listed.stdout.split())


def members(tree: ast.Module) -> Names:
    """Classes with what they define; "" is the module itself."""
    found: Names = {"": set()}
    for node in tree.body:
        found[""] |= defined(node)
        if isinstance(node, ast.ClassDef):
            inner = found[node.name] = set()
            for each in ast.walk(node):
                inner |= defined(each)
    return found


def defined(node: ast.AST) -> set[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
        return {node.name}
    if isinstance(node, ast.ImportFrom):
        return {alias.asname or alias.name for alias in node.names}
    if isinstance(node, ast.Assign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        named = [part for target in targets for part in ast.walk(target)]
        return {part.id for part in named if isinstance(part, ast.Name)} | {
            part.attr for part in named if isinstance(part, ast.Attribute)
        }
    return set()


@cache
def modules() -> dict[str, Names]:
    """Dotted name -> what it defines; a package stands for its __init__.py."""
    out = {}
    for name, folder in PACKAGES.items():
        for path in folder.rglob("*.py"):
            parts = (name, *path.relative_to(folder).with_suffix("").parts)
            dotted = ".".join(parts).removesuffix(".__init__")
            out[dotted] = members(ast.parse(path.read_text()))
    return out


def is_there(dotted: str) -> bool:
    """Whether a name that begins with a package of ours is a module, or defined in one."""
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        module, rest = ".".join(parts[:length]), parts[length:]
        if module in modules():
            known = modules()[module]
            if len(rest) == 2:
                return rest[1] in known.get(rest[0], ())
            return not rest or rest[0] in known[""]
    return False


def problem(token: str) -> str | None:
    """Why what stands in backquotes does not exist; None: it does, or is no name of code."""
    if token in ELSEWHERE or token.rpartition(".")[2] in FILES:
        return None
    if "/" in token or token.endswith(".py"):
        return path_problem(token)
    parts = token.split(".")
    if parts[0] in PACKAGES:
        return None if is_there(token) else "no such module, class or function"
    owners = [known[parts[0]] for known in modules().values() if parts[0] in known]
    if len(parts) == 2 and owners:
        return None if any(parts[1] in each for each in owners) else f"{parts[0]} has no such thing"
    if len(parts) == 2 and (why := short_problem(*parts)):
        return why
    missing = [part for part in parts if part not in words() and ("_" in part or len(parts) > 1)]
    return f"{missing[0]} is nowhere in the code" if missing else None


def short_problem(module: str, name: str) -> str | None:
    """Of `module.name` without the package: also a setting is written so."""
    found = [d for d in modules() if d.endswith(f".{module}")]
    if any(name in modules()[d][""] or f"{d}.{name}" in modules() for d in found):
        return None
    is_class = name[0].isupper()
    fields = any(name in each for known in modules().values() for each in known.values())
    if is_class or (found and not fields):
        return f"no module {module} has it"
    return None


def path_problem(token: str) -> str | None:
    head, _, rest = token.partition("/")
    if not rest:
        inside = any(token in f"/{name}" for name in tracked() if token.endswith("/"))
        there = inside or any(f"/{name}".endswith(f"/{token}") for name in tracked())
        return None if there or (ROOT / token).exists() else "no such file"
    if head == "crash_coach_interfaces" and not rest.startswith("msg"):
        there = (ROOT / "ros_ws/src" / head / "msg" / f"{rest}.msg").exists()
        return None if there else "no such message"
    ours = head in PACKAGES or (ROOT / head).is_dir() or token.endswith(".py")
    if not ours or head == "runs":
        return None
    places = (ROOT / token, *(folder.parent / token for folder in PACKAGES.values()))
    if any(place.exists() for place in places):
        return None
    ends = any(f"/{name}".endswith(f"/{token}") for name in tracked())
    return None if ends else "no such file"


def named(text: str) -> list[str]:
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    found = [t for t in re.findall(r"`([^`\n]+)`", prose) if re.fullmatch(r"[A-Za-z]\w[\w./]*", t)]
    return [token for token in found if not re.search(r"_\d+$", token)]  # names of robots


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_names_exist(document: Path) -> None:
    problems = {t: problem(t) for t in named(document.read_text())}
    assert not {token: why for token, why in problems.items() if why}


def test_the_tree_of_the_architecture_exists() -> None:
    """Every file named in the drawing lies in the folder it is drawn in."""
    drawing = (ROOT / "docs" / "architecture.md").read_text().split("```")[1]
    lost = [name for name in re.findall(r"[\w/]+\.py\b", drawing) if path_problem(name)]
    assert not lost


@pytest.mark.parametrize(
    "token",
    [
        "policy_pkg.train.no_such_module", "policy_pkg.play.evaluate.evaluated",
        "Learner.no_such_method",
        "policy_pkg/train/no_such_file.py", "trainer_of_old.py", "tests/policy/test_no_such.py",
        "no_such_function_anywhere", "crash_coach_interfaces/NoSuchMessage",
    ],
)  # fmt: skip
def test_the_test_sees_what_does_not_exist(token: str) -> None:
    assert problem(token)
