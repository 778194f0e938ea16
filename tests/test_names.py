"""The names that `import eomc` and a built module offer, as tab completion lists them."""

from __future__ import annotations

import subprocess
import sys
from types import ModuleType

import pytest

import eomc

PUBLIC = {"System", "build", "dot", "equations", "export", "export_fmu", "load", "read"}
PUBLIC |= {"fit", "regressor", "sources", "sweep"}


def test_dir_lists_the_public_names_of_the_package() -> None:
    names = {name for name in dir(eomc) if not name.startswith("__")}
    assert names == PUBLIC | {"EomcError", "SceneError"}
    assert all(hasattr(eomc, name) for name in names)


def test_neither_import_nor_dir_imports_sympy() -> None:
    code = "import eomc, sys; dir(eomc); sys.exit('sympy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_dir_of_a_module_lists_its_functions_and_no_files(driven: ModuleType) -> None:
    names = {name for name in dir(driven) if not name.startswith("__")}
    assert names == set(driven.__all__) and {"simulate", "start", "defaults"} <= names


def test_notebooks_show_the_message_of_an_error_alone(driven: ModuleType) -> None:
    """IPython calls a method of errors for the lines that replace the traceback."""
    with pytest.raises(eomc.EomcError) as fault:
        eomc.load("nowhere.toml")
    assert fault.value._render_traceback_() == [f"{fault.type.__name__}: {fault.value}"]
    with pytest.raises(driven.MotionError) as stop:
        driven.step([0, 0.4], [0, 1e200], h=1.0)
    assert stop.value._render_traceback_() == [f"MotionError: {stop.value}"]
