"""Words of pages: names as they are, in Markdown too, and no folders of the machine."""

from pathlib import Path

import pytest

from tidefield.viewer.words import code, plain, shown, without_folders


def test_punctuation_is_not_taken_for_markdown():
    assert plain("a_b_ *c* [d](e) #1 <f> flats 2") == r"a\_b\_ \*c\* \[d\]\(e\) \#1 \<f\> flats 2"
    assert code("tidefield render a_b") == "`tidefield render a_b`"
    assert code("'a`b``c'") == "``` 'a`b``c' ```"


def test_names_that_are_not_utf_8_can_be_sent_and_stay_apart():
    names = [bytes([0xE9, k]).decode("utf-8", "surrogateescape") for k in (0x31, 0x32, 0xE9)]
    words = [shown(name) for name in names]
    assert words == [r"\xe91".replace("x", "udc"), r"\udce92", r"\udce9\udce9"]
    "".join([*words, *map(plain, names), *map(code, names)]).encode()


def test_messages_name_files_without_where_their_folders_lie(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    scenes = tmp_path / "one user's" / "scenes"
    for folder in (scenes / "flat", Path("one user's", "scenes", "flat"), Path("..", tmp_path.name, "flat")):
        message = f"{folder / 'images' / 'a.jpg'} cannot be read: see {scenes / 'flat'}, and a/b"
        assert str(tmp_path) not in without_folders(message, [folder])
        assert without_folders(message, [folder]).startswith(str(Path("flat", "images", "a.jpg")))
    assert without_folders("flat/images/a.jpg, 0.5 m/s", [Path("flat")]) == "flat/images/a.jpg, 0.5 m/s"
