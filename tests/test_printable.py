"""Text of others on terminals and pages: nothing in it steers, nothing hides, and words of all languages stay."""

from __future__ import annotations

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsseg_core.errors import GssegError, SceneFileError
from gsseg_core.text import one_line, printable, searched, table


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[31mred\x1b[0m", r"\x1b[31mred\x1b[0m"),
        ("two\r\nlines\tand\x07", r"two\r\nlines\tand\x07"),
        ("a\x85b\u2028c\u2029d", r"a\x85b\u2028c\u2029d"),
        ("exe.\u202egnp", r"exe.\u202egnp"),
        ("\u2066isolated\u2069", r"\u2066isolated\u2069"),
        ("zero\u200bwidth\ufeff", r"zero\u200bwidth\ufeff"),
        ("not \udcff UTF-8", r"not \udcff UTF-8"),
    ],
)
def test_characters_that_steer_or_hide_are_seen_as_their_escapes(text: str, shown: str) -> None:
    assert printable(text) == shown


@pytest.mark.parametrize(
    "text",
    [
        "Tasse \u00e4",
        "\u6905\u5b50\u3000\u4e8c",
        "\u0645\u06cc\u200c\u062e\u0648\u0627\u0647\u0645",
        "\U0001f469\u200d\U0001f680",
        "C:\\x1b",
        "a\u00a0b",
        "",
    ],
)
def test_words_of_all_languages_stay(text: str) -> None:
    assert printable(text) == text


@given(st.text(st.characters()))
def test_any_text_is_one_line_that_can_be_encoded_and_a_second_time_changes_nothing(text: str) -> None:
    shown = printable(text)
    shown.encode()
    assert not {unicodedata.category(c) for c in shown} & {"Cc", "Cs", "Zl", "Zp"}
    assert shown.splitlines() in ([shown], []) and printable(shown) == shown


@pytest.mark.parametrize("name", ["a\nb", "\x1b[31mred", "x" * 1_000_000, "\u202e" * 5_000])
def test_an_error_about_any_name_is_one_short_line_that_ends_with_what_was_wrong(name: str) -> None:
    shown = str(SceneFileError(f"{name}: does not exist"))
    assert shown.isprintable() and len(shown) <= 1000 and shown.endswith(": does not exist")
    assert str(GssegError(shown)) == shown == one_line(shown)


@pytest.mark.parametrize(
    ("typed", "name"),
    [
        ("t\u00fcr", "Tu\u0308r"),
        ("istanbul", "\u0130stanbul"),
        ("I\u015eIK", "\u0131\u015f\u0131k"),
        ("STRASSE", "Stra\u00dfe"),
    ],
)
def test_what_is_searched_for_is_found_though_its_letters_are_small_or_large(typed: str, name: str) -> None:
    assert searched(typed) == searched(name)
    assert searched("isik") not in searched("\u0131\u015f\u0131k"), "an accent makes another letter"


def test_columns_of_a_table_stand_below_each_other_though_letters_are_wide_or_join_others() -> None:
    names = ["chair", "\u6905\u5b50", "\uff21", "Tu\u0308r", "\U0001f4f7\ufe0f", "\ud55c\uad6d\uc5b4"]
    wide = (0, 2, 1, -1, 0, 3)  # columns that each takes beyond its characters: the selector of an emoji takes none
    lines = table(["class", "Gaussians"], [[name, "1,234"] for name in names]).split("\n")
    assert [len(line) + more for line, more in zip(lines[2:], wide, strict=True)] == [len(lines[0])] * len(names)
