"""The arrows of docs/architecture.md, read from the source: nothing points up, nothing goes in
circles.
"""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LINKED = ("envs_jax", "models", "agents", "tools")
LAYERS = (*LINKED, "bridge")
OTHERS = ("tests", "examples", "docs")

# What each layer may know of the package, and which of the declared libraries it may see.
TOOLS_EXTRAS = ("tyro", "rich", "matplotlib", "jinja2", "pygame", "tensorboard", "wandb", "ray")
MAY_IMPORT = {
    "envs_jax": {"envs_jax"},
    "bridge": {"bridge", "envs_jax"},
    "models": {"models"},
    "agents": {"agents", "models", "bridge", "envs_jax"},
    "tools": {"tools", "agents", "models", "bridge", "envs_jax"},
}
LIBRARIES = {
    "envs_jax": {"jax", "jaxlib", "numpy"},
    "bridge": {"torch", "torchrl", "tensordict", "jax", "jaxlib", "numpy", "gymnasium", "pygame"},
    "models": {"torch", "torchrl", "tensordict", "numpy", "triton", "sb3_contrib"},
    "agents": {
        "torch",
        "torchrl",
        "tensordict",
        "jax",
        "numpy",
        "scipy",
        "safetensors",
        "filelock",
        "huggingface_hub",
    },
    "tools": {"torch", "torchrl", "tensordict", "jax", "numpy", "safetensors", *TOOLS_EXTRAS},
}


@cache
def modules() -> dict[str, Path]:
    """All modules of the package by their dotted name."""
    found = {}
    for path in sorted((ROOT / "arcade_torch").glob("*.py")):
        found["arcade_torch" if path.stem == "__init__" else f"arcade_torch.{path.stem}"] = path
    for folder in (*LINKED, "arcade_torch/gym"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            name = ".".join(parts if parts[0] == "arcade_torch" else ("arcade_torch", *parts))
            found[name.removesuffix(".__init__")] = path
    return found


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def layer_of(module: str) -> str:
    """The layer a module of the package belongs to: one of the four linked folders, or the
    bridge.
    """
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and parts[1] in LINKED else "bridge"


def imports(node: ast.AST) -> list[tuple[str, int]]:
    """Every module that is imported anywhere below `node`, as (dotted name, line)."""
    found = []
    for child in ast.walk(node):
        if isinstance(child, ast.Import):
            found += [(alias.name, child.lineno) for alias in child.names]
        elif isinstance(child, ast.ImportFrom):
            base = "." * child.level + (child.module or "")
            # `from arcade_torch import models` names the module models, `from arcade_torch import
            # make` a function.
            submodules = [
                f"{base}.{alias.name}"
                for alias in child.names
                if f"{base}.{alias.name}" in modules()
            ]
            found += [(name, child.lineno) for name in submodules or [base]]
    return found


def lazily_named(path: Path) -> list[str]:
    """Modules that stand in a string handed to `import_module`, or in a table of lazy public
    names.
    """
    strings = [node.value for node in ast.walk(tree(path)) if isinstance(node, ast.Constant)]
    return [text for text in strings if isinstance(text, str) and text in modules()]


@pytest.mark.parametrize("layer", LAYERS)
def test_no_import_points_up(layer: str) -> None:
    wrong = []
    for name, path in modules().items():
        if layer_of(name) != layer:
            continue
        named = [*imports(tree(path)), *((text, 0) for text in lazily_named(path))]
        for target, line in named:
            if target.split(".")[0] == "arcade_torch" and layer_of(target) not in MAY_IMPORT[layer]:
                wrong.append(
                    f"{path.relative_to(ROOT)}:{line} ({layer}) imports {target} "
                    f"({layer_of(target)})"
                )
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("layer", LAYERS)
def test_a_layer_sees_only_the_libraries_that_are_its_business(layer: str) -> None:
    allowed = LIBRARIES[layer] | sys.stdlib_module_names | {"arcade_torch"}
    wrong = [
        f"{path.relative_to(ROOT)}:{line} ({layer}) imports {target}"
        for name, path in modules().items()
        if layer_of(name) == layer
        for target, line in imports(tree(path))
        if target.split(".")[0] not in allowed
    ]
    assert not wrong, "\n".join(wrong)


def test_imports_of_the_package_are_absolute() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {target}"
        for path in modules().values()
        for target, line in imports(tree(path))
        if target.startswith(".")
    ]
    assert not wrong, "write `from arcade_torch.models.scan import ...`:\n" + "\n".join(wrong)


BARE = re.compile(rf"^\s*(?:from|import)\s(?:.*[ \t,])?(?:{'|'.join(LINKED)})\b", re.MULTILINE)


def test_nobody_imports_a_code_folder_by_its_bare_name() -> None:
    everything = [
        *modules().values(),
        *(path for folder in OTHERS for path in (ROOT / folder).rglob("*.py")),
    ]
    # Reading a file takes a hundredth of parsing it.
    suspicious = [path for path in everything if BARE.search(path.read_text(encoding="utf-8"))]
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {target}"
        for path in suspicious
        for target, line in imports(tree(path))
        if target.split(".")[0] in LINKED
    ]
    assert not wrong, "write `from arcade_torch.models.scan import ...`:\n" + "\n".join(wrong)


def test_a_bare_name_is_seen_in_every_form_of_an_import() -> None:
    for line in (
        "import tools",
        "import os, models",
        "    from agents.runs import a",
        "import envs_jax.x",
    ):
        assert BARE.search(f"x = 1\n{line}\n")
    assert not BARE.search("from arcade_torch.models import a\nmodels = 1\n")


def at_import_time(path: Path) -> list[str]:
    """Modules of the package that are imported when this one is: not those inside functions or
    under TYPE_CHECKING.
    """
    found: list[str] = []
    todo: list[ast.stmt] = list(tree(path).body)
    while todo:
        node = todo.pop()
        if isinstance(node, ast.Import | ast.ImportFrom):
            found += [target for target, _ in imports(node) if target in modules()]
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            todo += node.orelse
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            todo += [
                child for child in ast.walk(node) if isinstance(child, ast.Import | ast.ImportFrom)
            ]
    return found


def test_modules_import_each_other_without_circles() -> None:
    graph = {name: set(at_import_time(path)) - {name} for name, path in modules().items()}
    while graph:
        leaves = {name for name, targets in graph.items() if not targets & graph.keys()}
        assert leaves, f"a circle among: {', '.join(sorted(graph))}"
        graph = {name: targets - leaves for name, targets in graph.items() if name not in leaves}


def test_no_command_leads_back_to_the_command_line_that_imports_it_by_name() -> None:
    """Late imports count too: `cli` imports every module of `tools.commands` by a string."""
    graph = {
        name: {target for target, _ in imports(tree(path))} for name, path in modules().items()
    }
    reached = {name for name in graph if name.startswith("arcade_torch.tools.commands")}
    while more := {target for name in reached for target in graph.get(name, ())} - reached:
        reached |= more
    assert "arcade_torch.tools.cli" not in reached


@pytest.mark.parametrize("folder", LINKED)
def test_the_code_folders_are_linked_into_the_package_by_relative_links(folder: str) -> None:
    link = ROOT / "arcade_torch" / folder
    assert link.is_symlink(), f"arcade_torch/{folder} has to be a symbolic link to ../{folder}"
    assert link.readlink() == Path("..") / folder


# What is imported without torch and JAX, and what with one of them: a process each, since importing
# torch takes three seconds. What a statement loads is there for all below it.
LIGHT = (
    ("import arcade_torch", {"torch", "tensordict", "torchrl", "jax"}),
    ("import arcade_torch.envs_jax", {"torch", "tensordict", "torchrl", "jax"}),
    (
        "import arcade_torch; arcade_torch.registered_ids()",
        {"torch", "tensordict", "torchrl", "jax"},
    ),
    ("import arcade_torch.agents.presets", {"torch", "tensordict", "torchrl", "jax"}),
    ("import arcade_torch.tools.commands.train", {"torch", "tensordict", "torchrl", "jax"}),
    ("import arcade_torch.tools.commands.figure", {"torch", "torchrl", "jax", "matplotlib"}),
    ("import arcade_torch.tools.measures.gap_bias.measure", {"torch", "jax", "matplotlib"}),
    (
        "import arcade_torch.envs_jax as games; games.make('CartPoleEasy')",
        {"torch", "tensordict", "torchrl"},
    ),
)
MEASURES = ("saliency", "recall_density", "contamination", "counterfactual", "beliefs")
WITH_TORCH = (
    *(
        (
            f"import arcade_torch.tools.measures.{measure}.measure",
            {"torchrl", "jax", "matplotlib", "tyro"},
        )
        for measure in MEASURES
    ),
    ("import arcade_torch.models", {"jax", "jaxlib"}),
)


@cache
def loaded_after(statements: tuple[str, ...]) -> dict[str, set[str]]:
    """Top-level modules in memory after a statement, of those that one fresh interpreter runs."""
    print_loaded = "print(' '.join(sorted({name.split('.')[0] for name in sys.modules})))"
    lines = [line for statement in statements for line in (statement, print_loaded)]
    result = subprocess.run(
        [sys.executable, "-c", "\n".join(["import sys", *lines])],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    loaded = [set(line.split()) for line in result.stdout.splitlines()]
    return dict(zip(statements, loaded, strict=True))


@pytest.mark.parametrize("chain", [LIGHT, WITH_TORCH], ids=["light", "with torch"])
def test_importing_a_layer_loads_nothing_that_it_does_not_need(
    chain: tuple[tuple[str, set[str]], ...],
) -> None:
    loaded = loaded_after(tuple(statement for statement, _ in chain))
    for statement, absent in chain:
        assert not loaded[statement] & absent, statement


def test_the_public_names_of_the_package_resolve() -> None:
    import arcade_torch

    for name in arcade_torch.__all__:
        assert getattr(arcade_torch, name) is not None
        assert name in dir(arcade_torch)
    with pytest.raises(AttributeError, match=r"public names: ArcadeCollector"):
        _ = arcade_torch.no_such_name


def calls(path: Path) -> list[tuple[str, ast.Call]]:
    found = []
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute | ast.Name):
            found.append((ast.unparse(node.func), node))
    return found


def is_true(call: ast.Call, keyword: str) -> bool:
    return any(
        k.arg == keyword and isinstance(k.value, ast.Constant) and k.value.value is True
        for k in call.keywords
    )


def test_nothing_is_unpickled() -> None:
    wrong = []
    for path in modules().values():
        where = path.relative_to(ROOT)
        for target, line in imports(tree(path)):
            if target.split(".")[0] in {"cloudpickle", "dill", "joblib", "shelve", "marshal"}:
                wrong.append(f"{where}:{line} imports {target}")
        # `import pickle` alone is no fault: its exceptions are what a corrupt checkpoint raises.
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.ImportFrom) and node.module == "pickle":
                wrong += [
                    f"{where}:{node.lineno} {a.name}"
                    for a in node.names
                    if not a.name.endswith("Error")
                ]
        for name, call in calls(path):
            if name in {"pickle.load", "pickle.loads", "pickle.Unpickler"}:
                wrong.append(f"{where}:{call.lineno} {name}")
            if name == "torch.load" and not is_true(call, "weights_only"):
                wrong.append(f"{where}:{call.lineno} torch.load without weights_only=True")
            if name in {"np.load", "numpy.load", "jnp.load"} and is_true(call, "allow_pickle"):
                wrong.append(f"{where}:{call.lineno} {name} with allow_pickle=True")
    assert not wrong, "\n".join(wrong)
