"""The page is well formed, complete in itself, and shows texts as they are."""

import base64
import io
import re
from html.parser import HTMLParser

import numpy as np
from numpy.testing import assert_array_equal
from PIL import Image

from relightcli.adapters.html import Picture, Section, Table, page, png_data_uri

VOID = {"meta", "img"}


class Checker(HTMLParser):
    """Collects tags and text; fails on tags that do not nest."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.text = [], [], ""

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def parse(text):
    checker = Checker()
    checker.feed(text)
    assert checker.open == []
    return checker


def test_page_nests_and_shows_everything():
    picture = Picture(png_data_uri(np.zeros((2, 3, 3), np.uint8)), 'a "b" <c>')
    text = page(
        "T & U", "one\n\ntwo", [Section("S", "text", [picture], [Table(["k", "v"], [["<x>", 0.125], ["n", 3]])])]
    )
    checker = parse(text)
    for part in ("T & U", "one", "two", "S", "text", 'a "b" <c>', "<x>", "0.125", "3"):
        assert part in checker.text
    assert [tag for tag, _ in checker.tags].count("p") == 3
    image = next(attributes for tag, attributes in checker.tags if tag == "img")
    assert image["alt"] == 'a "b" <c>'


def test_page_needs_nothing_else():
    text = page("T", "", [Section("S", pictures=[Picture(png_data_uri(np.zeros((2, 2, 3), np.uint8)), "p")])])
    assert "<script" not in text
    assert not re.search(r"https?://|url\(|@import|<link", text)


def test_data_uri_holds_the_picture():
    pixels = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    head, _, data = png_data_uri(pixels).partition(",")
    assert head == "data:image/png;base64"
    assert_array_equal(np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))), pixels)
