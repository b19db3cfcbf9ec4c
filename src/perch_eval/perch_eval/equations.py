"""Write docs/equations.md, the index of where each equation of both papers is defined, from the tags in docstrings.

`[defines M:eq15]` marks the one function or class that implements the equation: the place to change it. This code must be in use,
that is, reachable from a node's program by names and imports. Other code related to it is tagged `[uses M:eq15]` or `[M:eq15]`.
`[tests M:eq15]` in a test file promises that a test there fails where the definition is wrong; a test that only mentions the
equation, or takes the definition for the truth, has no such tag.
A tag may name several equations: `[P:eq3-7]`, `[M:eq2,12,13]`, `[M:alg1]`; a letter (`[P:eq14h]`) names a row.
"""

from __future__ import annotations

import ast
import re
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from perch_eval.arguments import command_parser
from perch_eval.evaluation.document import table
from perch_eval.revision import root

EXAMPLES = """examples:
  python3 scripts/equations.py                                       write docs/equations.md
  python3 scripts/equations.py && git diff docs/equations.md         see what has moved
  grep -rnI M:eq15 src                                               see all that has to do with an equation

exit code: 0 written, 1 written, but an equation has not exactly one definition in use"""
TITLES = {
    "M": {"eq1": "rigid-body dynamics", "eq2": "geometric control: thrust and moment", "eq3": "piecewise polynomials",
          "eq4": "cost: squared derivative", "eq5": "cost matrix of one segment", "eq6": "derivatives at a time",
          "eq7": "continuity", "eq8": "the quadratic program", "eq9": "thrust from the acceleration",
          "eq10": "b3 from the acceleration", "eq11": "acceleration at contact", "eq12": "commanded attitude",
          "eq13": "commanded body rates", "eq14": "impact speed window", "eq15": "tube before contact",
          "eq16": "thrust bounds", "eq17": "time-shifted segments", "eq18": "Sturm's sequence",
          "eq19": "the appendix's example of a Sturm sequence", "alg1": "global bound checking"},
    "P": {"eq1": "17-state dynamics", "eq2": "thrust and allocation", "eq3": "line in the scaled body frame",
          "eq4": "distance of the line from the ellipsoid", "eq5": "line collision constraint", "eq6": "segment activation",
          "eq7": "segment collision constraint", "eq8": "line in the camera frame", "eq9": "reprojection error",
          "eq10": "closest points in 2-D and 3-D", "eq11": "intersection of both", "eq12": "line cheirality",
          "eq13": "segment visibility", "eq14": "the nonlinear program", "eq15": "cost terms"},
}
REASONS = {
    ("M", "eq18"): "flights decide by subdivision: in floating point the chain accepts polynomials that break their bound",
    ("M", "eq19"): "an example of (18)",
}
"""Equations whose definition is not used in flight, with the reason."""

_ENTRY = "*_node.py"
_TAG = re.compile(r"\[(?:defines |uses |tests )?([MP]):((?:eq|alg)[^\]]*)\]")
_DEFINITION = re.compile(r"\[defines [^\]]*\]")
_TEST = re.compile(r"\[tests [^\]]*\]")
_NAMED = re.compile(r"(perch_[\w.]+):(\w+)")  # an entry of a registry
_Key = tuple[str, str]


@dataclass(frozen=True)
class Place:
    """A definition of an equation: file, name of function, class or module, and whether a node's program reaches it (`in_use`)."""

    file: str
    name: str
    in_use: bool


def equations_of(text: str) -> list[_Key]:
    """(paper, equation) of every tag in a text: `[M:eq2,12-13]` -> M eq2, eq12, eq13."""
    out = []
    for paper, body in _TAG.findall(text):
        for part in re.split(r",\s*", body):
            paper = part[0] if part[1:2] == ":" else paper
            kind = "alg" if body.startswith("alg") else "eq"
            numbers = [int(n) for n in re.findall(r"\d+", part)]
            if not numbers:
                continue
            last = numbers[1] if "-" in part and len(numbers) > 1 else numbers[0]
            out += [(paper, f"{kind}{n}") for n in range(numbers[0], last + 1)]
    return out


class _Module:
    """The top-level definitions of a module, and its imported names as (module, name) or (module, "")."""

    def __init__(self, path: Path, name: str) -> None:
        self.path, self.tree = path, ast.parse(path.read_text())
        self.package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        self.defined: dict[str, ast.stmt] = {}
        self.imported: dict[str, _Key] = {}
        for statement in self.tree.body:
            for target in getattr(statement, "targets", [getattr(statement, "target", statement)]):
                for leaf in ast.walk(target) if isinstance(statement, ast.Assign) else [target]:
                    if own := getattr(leaf, "name", getattr(leaf, "id", None)):
                        self.defined[own] = statement
        for node in ast.walk(self.tree):
            if isinstance(node, ast.ImportFrom):
                self.imported |= {alias.asname or alias.name: (node.module or "", alias.name) for alias in node.names}
            elif isinstance(node, ast.Import):
                self.imported |= {alias.asname or alias.name: (alias.name, "") for alias in node.names}


def _modules(root: Path) -> dict[str, _Module]:
    """Return the modules of the packages by dotted name."""
    out = {}
    for path in sorted((root / "src").glob("perch_*/perch_*/**/*.py")):
        name = ".".join(path.relative_to(root / "src").with_suffix("").parts[1:]).removesuffix(".__init__")
        out[name] = _Module(path, name)
    return out


def _reached(modules: dict[str, _Module]) -> set[_Key]:
    """Return (module, top-level name) of all that the nodes' programs refer to, also indirectly; a class counts as a whole."""
    out: set[_Key] = set()
    todo = [(name, top) for name, module in modules.items() if module.path.match(_ENTRY) for top in module.defined]
    while todo:
        module, name = todo.pop()
        if f"{module}.{name}" in modules or module not in modules or (module, name) in out:
            continue
        here = modules[module]
        if name not in here.defined:
            todo += [here.imported[name]] if name in here.imported else []
            continue
        out.add((module, name))
        for node in ast.walk(here.defined[name]):
            if isinstance(node, ast.Name):
                todo.append(here.imported.get(node.id, (module, node.id)))
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in here.imported:
                origin = here.imported[node.value.id]
                todo += [(".".join(filter(None, origin)), node.attr), origin]
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                todo += _NAMED.findall(node.value)
    return out


@lru_cache
def definitions(root: Path) -> dict[_Key, list[Place]]:
    """Return the places at which each equation is defined."""
    modules = _modules(root)
    found: dict[_Key, list[Place]] = {}
    reached = _reached(modules)
    modules.pop(__name__, None)  # it shows what a tag looks like
    for name, module in modules.items():
        for top in [module.tree, *module.tree.body]:
            for node in ast.walk(top) if isinstance(top, ast.ClassDef) else [top]:
                if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                    continue
                keys = [key for tag in _DEFINITION.findall(ast.get_docstring(node) or "") for key in equations_of(tag)]
                in_use = any(at == name for at, _ in reached) if top is module.tree else (name, getattr(top, "name", "")) in reached
                place = Place(str(module.path.relative_to(root)), getattr(node, "name", module.path.stem), in_use)
                for key in keys:
                    found.setdefault(key, []).append(place)
    return found


def problems(root: Path) -> list[str]:
    """Return the faults of the index, one line each: no definition, several, one that no program reaches, an unknown equation."""
    found, out = definitions(root), []
    for paper, titles in TITLES.items():
        for eq, title in titles.items():
            places, what = found.get((paper, eq), []), f"{paper}:{eq} ({title})"
            if len(places) != 1:
                out.append(f"{what} has {len(places)} definitions: {', '.join(f'{p.file} {p.name}' for p in places) or 'none'}")
            elif places[0].in_use == ((paper, eq) in REASONS):
                out.append(f"{what} is defined in {places[0].file} {places[0].name}, which " +
                           ("a program reaches although REASONS lists it" if places[0].in_use else "no program reaches"))
    return out + [f"{paper}:{eq} is no equation of the papers" for paper, eq in found if eq not in TITLES[paper]]


def page(root: Path) -> str:
    """The content of docs/equations.md."""
    found = definitions(root)
    tests: dict[_Key, list[Path]] = {}
    for path in sorted((root / "tests").rglob("*.py")):
        text = path.read_text() if path.name != "test_equations.py" else ""
        for key in dict.fromkeys(key for tag in _TEST.findall(text) for key in equations_of(tag)):
            tests.setdefault(key, []).append(path.relative_to(root))
    lines = ["# Where each equation is implemented", "",
             "Generated by `python3 scripts/equations.py` from the tags in the code. M = Mao et al., P = Paneque et al.",
             "Each test file that a row names fails where the definition is wrong.",
             "Unless its row gives a reason, flights use this definition. `grep -rnI M:eq15 src` finds what else has to do with it.",
             "`perch_planner/verifier.py` and `perch_planner/paper/paper_m.py` state an equation again, on purpose, so that they",
             "check it independently. A changed rule flies at once; tests and `scripts/plan.py` refuse its plans until these two say",
             "the same.",
             "As M prints it, section IV-C is [perch_planner/paper/paper_m.py](../src/perch_planner/perch_planner/paper/paper_m.py).", ""]
    for paper, titles in TITLES.items():
        rows = []
        for eq, title in titles.items():
            places = ", ".join(f"[`{re.sub('^src/[^/]+/', '', p.file)}: {p.name}`](../{p.file})" for p in found.get((paper, eq), []))
            reason = f"; {REASONS[paper, eq]}" if (paper, eq) in REASONS else ""
            checks = ", ".join(f"[{path.name}](../{path})" for path in tests.get((paper, eq), []))
            number = f"({eq[2:]})" if eq.startswith("eq") else "algorithm 1"
            rows.append((f"{paper} {number}", f"{title}{reason}", places, checks))
        lines += [f"## Paper {paper}", "", *table("equation | what | definition | tests", rows), ""]
    return "\n".join(lines)


def main() -> int:
    """Write docs/equations.md; return 1 if the index has faults, otherwise 0."""
    command_parser("equations.py", __doc__, EXAMPLES).parse_args()
    (root() / "docs" / "equations.md").write_text(page(root()))
    for line in (wrong := problems(root())):
        print(line, file=sys.stderr)
    return 1 if wrong else 0
