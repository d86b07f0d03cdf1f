"""The streams of version 2: valid ones decode to their numbers, damaged ones are refused there."""

import json
import random
from pathlib import Path

import numpy as np
import pytest

from p4dgs_ref.codec.container import BitstreamError
from p4dgs_ref.oracle.streams import TYPES
from tests.codec.models import flips, prefixes, refusal
from tests.sampling import SEED
from tests.workshop.decoded import arrays_of
from tutorials.experiments.coded_networks.file import decode, encode, quantised_of, read_container

STREAMS = Path(__file__).with_name("streams")
ROWS = json.loads((STREAMS / "manifest.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("row", ROWS["good"], ids=lambda row: row["name"])
def test_a_stream_decodes_to_its_numbers_and_is_encoded_again(row):
    data, expected = ((STREAMS / row[name]).read_bytes() for name in ("file", "expected"))
    quantised = quantised_of(read_container(data))
    found = arrays_of(quantised)
    for entry in row["arrays"]:
        a, name = np.asarray(found[entry["name"]][1]), entry["name"]
        if entry["type"] == "bit":
            stored = np.packbits(a.astype(bool), bitorder="little").tobytes()
        else:
            stored = a.astype(TYPES[entry["type"]]).tobytes()
        assert [*a.shape] == entry["shape"], name
        assert expected[entry["offset"] :].startswith(stored), name
    assert encode(quantised.model) == data


@pytest.mark.parametrize("row", ROWS["bad"], ids=lambda row: row["name"])
def test_a_damaged_stream_is_refused_at_its_byte(row):
    error = refusal(decode, (STREAMS / row["file"]).read_bytes())
    assert error.section == row["section"] and row["offset"] in (None, error.offset)


@pytest.mark.parametrize("row", ROWS["good"], ids=lambda row: row["name"])
def test_hostile_bytes_raise_no_other_error(row):
    data = (STREAMS / row["file"]).read_bytes()
    sections = {name: bytes(body) for name, body in read_container(data).items()}
    for bad in random.Random(SEED).sample([*prefixes(data), *flips(data)], 200):
        refusal(decode, bad)
    for name, body in sections.items():  # behind the checksum
        changes = [*prefixes(body), *flips(body)]
        for bad in random.Random(SEED).sample(changes, min(40, len(changes))):
            try:
                quantised_of({**sections, name: bad})
            except BitstreamError as error:
                assert error.message
