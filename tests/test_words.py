"""The word list of `make check`: the spellings of a refused word that it detects."""

import importlib.util
from pathlib import Path

import pytest

SPEC = importlib.util.spec_from_file_location("words", Path(__file__).parents[1] / "tools/words.py")
words = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(words)


@pytest.mark.parametrize(
    "text",
    [
        "colour",
        "a Colour.",
        "old_colour_ms",
        "OldColourMap",
        "COLOUR_MAP",
        "x = colour(1)",
        "bright red",
        "bright\nred",
    ],
)
def test_refused_word_is_found(text):
    assert [line for line, _ in words.findings(text, {"colour": "color", "bright red": "red"})] == [1]


@pytest.mark.parametrize(
    "text", ["colours", "discoloured", "bright or red", "brightred", "colour = 1  # words: old names", ""]
)
def test_other_words_are_accepted(text):
    assert list(words.findings(text, {"colour": "color", "bright red": "red"})) == []


def test_every_refused_word_has_terms_to_use():
    assert all(terms.strip() for terms in words.refused().values())


def test_sources_and_documents_have_no_refused_word(capsys):
    assert words.main() == 0, capsys.readouterr().out
