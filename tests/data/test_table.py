"""The table parser: exact, and exact about what is wrong where."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from tests.cases import each

from icalib.data.tables import TableKind, read_table
from icalib.errors import RecordingError

INTEGERS, DECIMALS = ("t [ns]", "id"), ("u", "v")


def read(tmp_path: Path, content: str | bytes, name: str = "a.csv"):
    path = tmp_path / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_table(path, TableKind(INTEGERS, DECIMALS))


def test_integers_are_exact_beyond_float64(tmp_path):
    stamps = [1404733405747800065, 9223372036854775807, -9223372036854775807, 0, 2**53 + 1]
    table = read(tmp_path, "".join(f"{t},7,0.5,1\n" for t in stamps))
    assert table.integers[:, 0].tolist() == stamps


def test_decimals_agree_with_python(tmp_path):
    rng = np.random.default_rng(1)
    texts = [repr(float(x)) for x in rng.normal(size=200) * 10.0 ** rng.integers(-12, 12, 200)]
    texts += ["-0.099134701513277898", "1", "+2.", ".5", "1e-5", "-2.5E+3", "0", "-0.0", "0.000", "1e-320", "1e300"]
    texts += ["123456789012345678901234567890", "0.0000000000000000000001234567890123456789", "00012.5", "5e-324"]
    table = read(tmp_path, "".join(f"1,2,{x},{x}\n" for x in texts))
    np.testing.assert_allclose(table.decimals[:, 0], [float(x) for x in texts], rtol=4e-16, atol=5e-324)


def test_short_decimals_are_exact(tmp_path):
    texts = [f"{x / 10000:.4f}" for x in range(1, 7520000, 9973)]
    table = read(tmp_path, "".join(f"1,2,{x},0\n" for x in texts))
    assert table.decimals[:, 0].tolist() == [float(x) for x in texts]


@each(
    "content",
    [
        "t_ns,id,u,v\n1,2,3,4\n",
        "#ts,id,u,v\n1,2,3,4\n",
        "\ufeff#ts,id,u,v\r\n1,2,3,4\r\n",
        '"t","id","u","v"\n1,2,3,4',
        "\n# a\n# b\nt,id,u,v\n\n 1 ,\t2, 3 ,4 \n\n# end",
    ],
)
def test_headers_comments_blanks_and_line_ends(tmp_path, content):
    table = read(tmp_path, content)
    assert table.integers.tolist() == [[1, 2]]
    assert table.decimals.tolist() == [[3.0, 4.0]]


def test_gzip_is_told_by_its_content(tmp_path):
    assert len(read(tmp_path, gzip.compress(b"1,2,3,4\n"), "a.csv").decimals) == 1


HEAD = "t,id,u,v\n1,2,3,4\n"


@each(
    ("content", "words"),
    [
        ("", "is empty"),
        (" \n\n", "is empty"),
        ("t,id,u,v\n", "holds no rows"),
        (HEAD + "1,2,3\n", ":3: the line has 3 columns instead of 4"),
        (HEAD + "1,2,3,4,5\n", ":3: the line has 5 columns instead of 4"),
        ("1,2,3,4,5\n", "; name those to be read by `columns` in the rig file"),
        (HEAD + "1,2,3,4,\n", ":3: the line has 5 columns"),
        (HEAD + "# c\n\n1,2,3,abc\n", ":5: v is 'abc', which is not a number"),
        (HEAD + "t,id,u,v\n", ":3: t [ns] is 't', which is not a number"),
        (HEAD + "1,2,,4\n", ":3: u is '', which is not a number"),
        (HEAD + "1,2,3,4x\n", ":3: v is '4x', which is not a number"),
        (HEAD + "1,2,3,1e\n", ":3: v is '1e', which is not a number"),
        (HEAD + "1,2,nan,4\n", ":3: u is 'nan', which is not a finite number"),
        (HEAD + "1,2,3,-inf\n", ":3: v is '-inf', which is not a finite number"),
        (HEAD + "1,2,3,1e400\n", ":3: v is '1e400', which is not a finite number"),
        ("nan,2,3,4\n", ":1: t [ns] is 'nan', which is not a finite number"),
        (HEAD + "1404.5,2,3,4\n", ":3: t [ns] is 1404.5, but must be a whole number below 2^63 (stamps in seconds"),
        (HEAD + "1,2.0,3,4\n", ":3: id is 2.0, but must be a whole number"),
        (HEAD + "9223372036854775808,2,3,4\n", ":3: t [ns] is 9223372036854775808, but must be a whole number"),
        (HEAD + "1,2,3,1_0\n", ":3: v is '1_0', which is not written as a plain decimal number"),
        (HEAD + "1,2,3,4\x00\n", ":3: v is '4"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, content, words):
    with pytest.raises(RecordingError) as error:
        read(tmp_path, content)
    assert words in str(error.value)
    assert "a.csv" in str(error.value)


@each("keep", [5, 12, -20, -4])
def test_truncated_gzip(tmp_path, keep):
    whole = gzip.compress("".join(f"{k},2,3.25,4\n" for k in range(1000)).encode())
    with pytest.raises(RecordingError, match=r"a\.csv\.gz is a damaged or truncated gzip file .* copy it again"):
        read(tmp_path, whole[:keep], "a.csv.gz")


def test_gzip_with_a_flipped_byte(tmp_path):
    damaged = bytearray(gzip.compress("".join(f"{k},2,3.25,4\n" for k in range(1000)).encode()))
    damaged[len(damaged) // 2] ^= 0xFF
    with pytest.raises(RecordingError, match="damaged or truncated gzip"):
        read(tmp_path, bytes(damaged), "a.csv.gz")


def test_plain_text_named_gz(tmp_path):
    with pytest.raises(RecordingError, match="damaged or truncated gzip"):
        read(tmp_path, "1,2,3,4\n", "a.csv.gz")
