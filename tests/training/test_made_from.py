"""The digest of what a result was made from, and the source files that it covers."""

import sys

import pytest

from modsoft.training import made_from

ROLLOUT = "modsoft.training.simulation.rollout"


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package `modsoft_example` of two modules; returns its folder."""
    folder = tmp_path / "modsoft_example"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "one.py").write_text("def load():\n    from modsoft_example import two\n")
    (folder / "two.py").write_text("value = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield folder
    made_from.sources.cache_clear()
    for name in [name for name in sys.modules if name.startswith("modsoft_example")]:
        del sys.modules[name]


def test_sources_are_those_imported_directly_or_through_others():
    names = made_from.sources(ROLLOUT)
    assert {ROLLOUT, "modsoft.runtime.control.controller", "modsoft.runtime.control.actuation"} <= set(names)
    assert "modsoft.runtime.control.task_tables" in made_from.sources("modsoft.runtime.control.tasks")


def test_compiled_kernel_belongs_to_the_simulation():
    assert "modsoft.training.simulation/fleet.c" in made_from.sources("modsoft.training.simulation.fleet")


def test_import_inside_a_function_counts(package):
    assert "modsoft_example.two" in made_from.sources("modsoft_example.one")


def test_import_for_type_checking_does_not_count(package):
    text = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from modsoft_example import two\n"
    (package / "one.py").write_text(text)
    assert set(made_from.sources("modsoft_example.one")) == {"modsoft_example.one"}


def test_modules_without_effect_are_left_out_and_exist():
    assert not made_from.WITHOUT_EFFECT & set(made_from.sources(ROLLOUT))
    for name in made_from.WITHOUT_EFFECT:
        assert made_from._file(name), name


def test_unknown_module_is_refused():
    with pytest.raises(ValueError, match=r"no source file of modsoft\.nothing"):
        made_from.sources("modsoft.nothing")


@pytest.mark.parametrize("change", ["settings", "file", "file name", "imported module"])
def test_digest_changes(package, tmp_path, change):
    path = tmp_path / "input"
    path.write_text("1")

    def digest():
        made_from.sources.cache_clear()
        return made_from.digest(settings, [path], ["modsoft_example.one"])

    settings = {"seed": 0}
    before = digest()
    assert digest() == before
    match change:
        case "settings":
            settings["seed"] = 1
        case "file":
            path.write_text("2")
        case "file name":
            path = path.rename(tmp_path / "other")
        case "imported module":
            (package / "two.py").write_text("value = 2\n")
    assert digest() != before
