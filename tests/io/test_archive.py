"""jaxsr.io.archive: whatever a damaged or hostile archive holds, it is one line, soon, and in little memory.

That what is packed comes back within the stated errors is tested in tests/experiments/test_make_datasets.py.
"""

import hashlib
import json
import lzma
import os
import struct
import time
import tracemalloc
import zipfile

import numpy as np
import pytest

from jaxsr.data.sample import sample_folder
from jaxsr.errors import JaxsrError
from jaxsr.io import archive
from jaxsr.io.archive_coding import _FILTERS, decode_frame
from jaxsr.io.description import frame_info
from jaxsr.io.sequence import Sequence
from tests.builders import make_sequence

MEMBER = "tiny/hr/0001"


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """An archive of one tiny sequence: its file, its manifest and its members."""
    folder = tmp_path_factory.mktemp("archive")
    sequence = make_sequence(folder / "tiny", size=(16, 12), frames=2, scales=(2,))
    archive.pack({"tiny": sequence.path}, folder / "a.jsrz")
    with zipfile.ZipFile(folder / "a.jsrz") as file:
        members = {name: file.read(name) for name in file.namelist()}
    manifest = json.loads(members.pop("manifest.json"))
    return folder / "a.jsrz", manifest, members


def rebuilt(path, manifest, members):
    """An archive whose manifest has the right hashes of whatever the members are."""
    hashes = {name: hashlib.sha256(data).hexdigest() for name, data in members.items()}
    with zipfile.ZipFile(path, "w") as file:
        for name, data in members.items():
            file.writestr(name, data)
        file.writestr("manifest.json", json.dumps(manifest | {"members": hashes}))
    return path


def unpack(path, folder):
    return archive.unpack_sequence(path, archive.read_manifest(path), "tiny", folder)


def refused(call, message):
    """The call raises one line that matches, in little time and memory."""
    tracemalloc.start()
    start = time.monotonic()
    try:
        with pytest.raises(JaxsrError, match=message) as caught:
            call()
        seconds, (_, peak) = time.monotonic() - start, tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert seconds < 5
    assert peak < 60e6
    assert "\n" not in str(caught.value)


def blob_of(notes, body=b""):
    head = json.dumps(notes, separators=(",", ":")).encode() if isinstance(notes, dict) else notes
    return struct.pack("<I", len(head)) + head + body


def notes_of(blob):
    (length,) = struct.unpack_from("<I", blob)
    return json.loads(blob[4 : 4 + length]), blob[4 + length :]


def test_the_rebuilt_archive_unpacks(packed, tmp_path):
    _, manifest, members = packed
    assert len(Sequence.open(unpack(rebuilt(tmp_path / "b.jsrz", manifest, members), tmp_path / "out"))) == 2
    assert blob_of(*notes_of(members[MEMBER])) == members[MEMBER]


def test_archives_that_were_shipped_decode_to_the_same_values():
    """Only differences from a predicted motion are stored: its roundings are part of the format."""
    path = sample_folder() / "docks-test.jsrz"
    name, head = next(iter(archive.read_manifest(path)["sequences"].items()))
    before, info = (frame_info(entry, k, "docks") for k, entry in enumerate(head["frames"][:2]))
    with zipfile.ZipFile(path) as file:
        blob = file.read(f"{name}/x2/{info.index:04d}")
    layers = decode_frame(blob, (108, 192), info, before, info.jitter_px)
    y, x = [0, 1, 3, 3, 40, 70, 90], [171, 149, 5, 169, 60, 100, 20]
    motion = [
        [4.80660152, -1.60584605],
        [3.47376466, -1.20636654],
        [1.28150845, 0.10352215],
        [4.65426588, -1.45451832],
        [1.37817013, 0.25193718],
        [1.57625258, 0.52949315],
        [0.50366968, 0.8094486],
    ]
    np.testing.assert_allclose(layers["motion"][y, x], motion, rtol=3e-7, atol=3e-7)
    np.testing.assert_allclose(layers["depth"][70, 100], 13.298683, rtol=1e-6)
    np.testing.assert_allclose(layers["base_color"][90, 20], [0.15896083, 0.13843161, 0.12213878], rtol=1e-6)


def test_members_of_rubbish_with_the_right_hash(packed, tmp_path):
    _, manifest, members = packed
    rng, whole = np.random.default_rng(0), members[MEMBER]
    half = len(whole) // 2
    rubbish = [b"", b"abc", b"\xff" * 100, blob_of(b"\xff\xfe"), blob_of(b"[" * 200_000), blob_of(b"[]")]
    rubbish += [blob_of({}), *(rng.bytes(300) for _ in range(5))]
    rubbish += [whole[:n] for n in (3, 40, half, len(whole) - 1)] + [whole[:half] + rng.bytes(half)]
    for k, blob in enumerate(rubbish):
        file = rebuilt(tmp_path / f"{k}.jsrz", manifest, members | {MEMBER: blob})
        message = rf"{k}\.jsrz, member .{MEMBER}.: cannot be decoded"
        refused(lambda file=file: unpack(file, tmp_path / "out"), message)
    assert not list(tmp_path.rglob("*.exr"))


DEPTH = {"dtype": "<u2", "kind": 0, "bytes": 0}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shape": [12, 1 << 40]}, "shape"),
        ({"shape": [6, 8]}, r"shape \[6, 8\] for \[12, 16\]"),
        ({"shape": None}, "shape"),
        ({"depth": [-1e300, 1e300]}, "limits of depth"),
        ({"depth": [0]}, "cannot be decoded"),
        ({"depth": "ab"}, "cannot be decoded"),
        ({"color_bits": 10**30}, "color_bits"),
        ({"color_bits": 5.5}, "color_bits"),
        ({"planes": []}, "cannot be decoded"),
        ({"planes": {}}, "no 'depth'"),
        ({"planes": {"light": []}}, "no 'light'"),
        ({"planes": {"depth": [{}]}}, "no 'dtype'"),
        ({"planes": {"depth": [DEPTH | {"kind": 9}]}}, "predictor 9"),
        ({"planes": {"depth": [DEPTH | {"bytes": -1}]}}, "a plane of -1 bytes"),
        ({"planes": {"depth": [DEPTH | {"bytes": 1 << 60}]}}, "bytes, where"),
        ({"planes": {"depth": [DEPTH | {"dtype": "O"}]}}, "other planes of 'depth'"),
        ({"planes": {"color": [DEPTH] * 10**4}}, "other planes of 'color'"),
        ({"ids": []}, "an object without an id"),
        ({"ids": ["a"] * 99}, "cannot be decoded"),
    ],
)
def test_notes_of_a_member_that_lie(packed, tmp_path, change, message):
    _, manifest, members = packed
    notes, body = notes_of(members[MEMBER])
    file = rebuilt(tmp_path / "a.jsrz", manifest, members | {MEMBER: blob_of(notes | change, body)})
    refused(lambda: unpack(file, tmp_path / "out"), message)


def test_a_plane_that_decompresses_to_much_more_than_the_image(packed, tmp_path):
    _, manifest, members = packed
    notes, body = notes_of(members[MEMBER])
    bomb = lzma.compress(bytes(100_000_000), lzma.FORMAT_RAW, filters=_FILTERS)
    notes["planes"]["depth"][0]["bytes"] = len(bomb)
    file = rebuilt(tmp_path / "a.jsrz", manifest, members | {MEMBER: blob_of(notes, bomb + body)})
    refused(lambda: unpack(file, tmp_path / "out"), "a plane of more bytes for 384")


def test_members_are_bounded_by_the_sizes_in_the_manifest(packed, tmp_path):
    _, manifest, members = packed
    file = rebuilt(tmp_path / "a.jsrz", manifest, members | {MEMBER: bytes(2_000_000)})
    refused(lambda: unpack(file, tmp_path / "out"), "not as jaxsr writes it; .*found 2000000 bytes, stored")
    tiny = manifest["sequences"]["tiny"]
    for size, what in (([1 << 40, 1 << 40], "bad size"), ([8194, 8194], "the images are too large")):
        manifest = manifest | {"sequences": {"tiny": tiny | {"size": size}}}
        file = rebuilt(tmp_path / "b.jsrz", manifest, members)
        refused(lambda file=file: archive.read_manifest(file), rf"b\.jsrz, tiny: {what}")


@pytest.mark.parametrize("kind", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_nothing_is_decompressed_by_zip(packed, tmp_path, kind):
    _, manifest, members = packed
    with zipfile.ZipFile(tmp_path / "a.jsrz", "w", kind) as file:
        file.writestr("manifest.json", json.dumps(manifest) + " " * 20_000_000)
    assert (tmp_path / "a.jsrz").stat().st_size < 100_000
    refused(lambda: archive.read_manifest(tmp_path / "a.jsrz"), "'manifest.json' is not as jaxsr writes it")
    with zipfile.ZipFile(tmp_path / "b.jsrz", "w") as file:
        file.writestr("manifest.json", json.dumps(manifest))
        file.writestr(MEMBER, members[MEMBER], kind)
    refused(lambda: unpack(tmp_path / "b.jsrz", tmp_path / "out"), "not as jaxsr writes it.*compressed")


def test_manifests_of_strangers(tmp_path):
    for text, message in [
        ("[" * 200_000, r"manifest\.json: the JSON is nested too deep"),
        ('{"format":' * 200_000, "nested too deep"),
        (b"\xff\xfe\x00", "not UTF-8"),
        ("{", "bad JSON"),
        ('{"format": NaN}', "bad JSON"),
        ("{}", "another kind of archive"),
    ]:
        with zipfile.ZipFile(tmp_path / "a.jsrz", "w") as file:
            file.writestr("manifest.json", text)
        refused(lambda: archive.read_manifest(tmp_path / "a.jsrz"), message)
    with zipfile.ZipFile(tmp_path / "a.jsrz", "w") as file:
        file.writestr("other", "")
    refused(lambda: archive.read_manifest(tmp_path / "a.jsrz"), r"no member 'manifest\.json'")


@pytest.mark.parametrize("name", ["a\0b", "a\nb", "\x1b[2J", "a/../../b", "..", "/a", "C:/a", "a\u202egnp"])
def test_names_that_lead_out_or_cannot_be_shown(packed, tmp_path, name):
    _, manifest, members = packed
    sequences = {name: manifest["sequences"]["tiny"]}
    file = rebuilt(tmp_path / "a.jsrz", manifest | {"sequences": sequences}, members)
    refused(lambda: archive.read_manifest(file), "unsafe name of a sequence")


def test_what_is_no_archive(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "rubbish").write_bytes(np.random.default_rng(0).bytes(5000))
    (tmp_path / "end").write_bytes(b"PK\5\6" + b"\xff" * 18)
    for name, message in [
        ("pipe", "is not a regular file; .*a named pipe"),
        ("empty", "empty: not an archive"),
        ("rubbish", "rubbish: not an archive"),
        ("end", "end: not an archive"),
        ("gone", "gone: no such file"),
        ("", "is a folder"),
    ]:
        refused(lambda name=name: archive.read_manifest(tmp_path / name), message)


def test_checksum_files_that_are_none(packed, tmp_path):
    file = tmp_path / "a.jsrz"
    file.write_bytes(packed[0].read_bytes())
    archive.verify(file)  # there is none
    os.mkfifo(tmp_path / "a.jsrz.sha256")
    refused(lambda: archive.verify(file), "is not a regular file")
    (tmp_path / "a.jsrz.sha256").unlink()
    (tmp_path / "a.jsrz.sha256").write_bytes(b"\xff" * 10_000)
    refused(lambda: archive.verify(file), "too large")


def test_archives_that_are_cut_or_changed_anywhere(packed, tmp_path):
    whole, rng = packed[0].read_bytes(), np.random.default_rng(0)
    file = tmp_path / "a.jsrz"
    for n in np.linspace(0, len(whole) - 1, 30).astype(int):
        file.write_bytes(whole[:n])
        refused(lambda: archive.read_manifest(file), r"a\.jsrz.*")
    directory = whole.index(b"PK\1\2")
    for k, at in enumerate(rng.choice(len(whole) - directory, 150, replace=False) + directory):
        data = bytearray(whole)
        data[at] ^= 1 << rng.integers(8)
        file.write_bytes(data)
        try:
            unpack(file, tmp_path / str(k))
        except JaxsrError as e:
            assert "\n" not in str(e)  # noqa: PT017


def test_layers_that_an_archive_does_not_hold_are_refused(tmp_path, monkeypatch):
    sequence = make_sequence(tmp_path / "s", size=(16, 12), frames=1)
    monkeypatch.delitem(archive.CODES, "normal")
    with pytest.raises(JaxsrError, match=r"0001\.exr: an archive cannot hold the layer 'normal'"):
        archive.pack({"s": sequence.path}, tmp_path / "a.jsrz")
    assert not (tmp_path / "a.jsrz").exists()
