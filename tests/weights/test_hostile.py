"""Files of weights that are made to harm: each is one line, in little time and memory, and nothing runs."""

import json
import os
import pickle
import struct
import time
import tracemalloc
import zipfile

import numpy as np
import pytest
from safetensors.numpy import save_file

from jaxsr.errors import JaxsrError
from jaxsr.runtime.load import find_method
from jaxsr.weights import archives, pickles
from jaxsr.weights.file import load_weights
from jaxsr.weights.pickles import unpickle
from jaxsr.weights.torch import read_published
from tests.test_cli import error_line
from tests.weights.test_weights import ordered, plain, tensor, write_pth

SECONDS = 10
MEGABYTES = 300


def refused(call, path, words, megabytes=MEGABYTES):
    """The one line of its error; it took little time and memory."""
    tracemalloc.start()
    started = time.monotonic()
    try:
        with pytest.raises(JaxsrError, match=words) as caught:
            call(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert time.monotonic() - started < SECONDS
    assert peak < megabytes * 1e6
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000
    assert str(path.name) in str(caught.value)


def weights(path, header, **arrays):
    """A safetensors file with this header, of which nothing need be true."""
    text = header if isinstance(header, str) else json.dumps(header)
    save_file(arrays or {"a": np.zeros(2, np.float32)}, path, {"jaxsr": text})


# Our own files.


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 200_000 + "]" * 200_000, "nested too deep"),
        ('{"method": ' + '{"a":' * 200_000 + "1" + "}" * 200_001, "nested too deep"),
        ('{"method": "rrn", "scale": NaN}', "NaN"),
        ('{"method": "rrn", "scale": 1e999}', "too large"),
        ('{"method": "rrn", "scale": ' + "9" * 5000 + "}", "an integer of 5000 digits"),
        ('{"method": ["rrn"]}', "does not say which method"),
        ("", "bad JSON"),
    ],
    ids=["lists", "objects", "nan", "infinity", "digits", "method", "empty"],
)
def test_headers_in_json(tmp_path, text, words):
    path = tmp_path / "a.safetensors"
    weights(path, text)
    refused(load_weights, path, words)


@pytest.mark.parametrize("size", [2**63, 2**64 - 1, 2**40, 10**8])
def test_a_header_of_safetensors_that_is_too_long(tmp_path, size):
    path = tmp_path / "a.safetensors"
    path.write_bytes(size.to_bytes(8, "little") + b'{"a": 1}')
    refused(load_weights, path, f"a header of {size} bytes, more than 16777216")


@pytest.mark.parametrize(
    ("method", "arguments"),
    [
        ("rrn", {"blocks": 10**7}),
        ("rrn", {"blocks": 65}),
        ("rrn", {"features": 2**40}),
        ("rrn", {"scale": 10**7}),
        ("rcan", {"blocks": 10**7}),
        ("rcan", {"groups": 10**7}),
        ("rcan", {"features": 10**9, "reduction": 1}),
        ("nsrr", {"previous": 10**7}),
    ],
)
def test_sizes_of_networks_in_a_header(tmp_path, method, arguments):
    path = tmp_path / "a.safetensors"
    weights(path, {"method": method, "arguments": arguments, "scale": 4})
    first, value = next(iter(arguments.items()))
    with pytest.raises(JaxsrError, match=f"a.safetensors: bad {first}; expected .*found {value}"):
        find_method(str(path), 4)


@pytest.mark.parametrize("arguments", [{"blocks": 16, "features": 1024}, {"features": 1, "blocks": 1}])
def test_a_header_of_another_network_than_its_arrays(tmp_path, arguments):
    path = tmp_path / "a.safetensors"
    weights(path, {"method": "rrn", "arguments": arguments, "scale": 4})
    refused(lambda p: find_method(str(p), 4), path, "do not fit the network; expected its")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite(tmp_path, value):
    bad = np.array([0, value], np.float32)
    arrays = {"good": np.zeros(2, np.float32), "later.kernel": bad, "middle.kernel": bad[:, None]}
    path = tmp_path / "a.safetensors"
    weights(path, {"method": "rrn"}, **arrays)
    refused(load_weights, path, "a.safetensors: (later|middle).kernel is not finite")
    path = tmp_path / "b.npz"
    np.savez(path, **arrays)
    refused(read_published, path, "b.npz: later.kernel is not finite")
    path = tmp_path / "c.pth"
    write_pth(path, ordered({"a.weight": tensor("0", (2,), (1,))}), {"0": bad.tobytes()})
    refused(read_published, path, "c.pth: a.weight is not finite")


def test_a_double_beyond_float32_is_not_finite(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.array([1e300]))
    refused(read_published, tmp_path / "a.npz", "a is not finite")


# Any file.


KINDS = (".safetensors", ".npz", ".pth", ".pt")


def sparse(path):
    path.touch()
    os.truncate(path, 2**31 + 1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("write", "words"),
    [
        (os.mkfifo, "is not a regular file; expected a file; found a named pipe"),
        (lambda p: p.touch(), "cannot read the weights; expected a whole"),
        (lambda p: p.mkdir(), "a folder, not a file of weights"),
        (lambda p: p.symlink_to(p), "cannot be read"),
        (sparse, "too large for a file of weights; expected at most 2147483648 bytes"),
        (lambda p: None, "no such file of weights"),
    ],
    ids=["pipe", "empty", "folder", "loop", "huge", "missing"],
)
def test_what_is_no_file_of_weights(tmp_path, kind, write, words):
    path = tmp_path / f"a{kind}"
    write(path)
    refused(read_published, path, words)
    if kind == ".safetensors":
        refused(load_weights, path, words)


def test_a_pipe_from_the_command_line(tmp_path, capsys):
    path = tmp_path / "a.pth"
    os.mkfifo(path)
    assert "found a named pipe" in error_line(capsys, "convert-weights", path, tmp_path / "out.safetensors")


# ZIP archives.


def npy(shape, content, dtype="<f4", version=(1, 0)):
    head = repr({"descr": dtype, "fortran_order": False, "shape": shape}).encode()
    head += b" " * (-(len(head) + 11) % 64) + b"\n"
    length = struct.pack("<H" if version == (1, 0) else "<I", len(head))
    return b"\x93NUMPY" + bytes(version) + length + head + content


def zipped(path, members, compression=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, content in members.items():
            file.writestr(name, content)


def lying(path, size):
    """A member of 70 MB in a small file, whose directory says that it has so many bytes."""
    content = npy((70 << 18,), bytes(70 << 20))
    zipped(path, {"a.npy": content})
    told, blob = struct.pack("<I", len(content)), path.read_bytes()
    assert blob.count(told) == 2
    path.write_bytes(blob.replace(told, struct.pack("<I", size)))


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda p: zipped(p, {"a.npy": npy((75 << 18,), bytes(75 << 20))}), "arrays of more than 67108864"),
        (lambda p: lying(p, 200), "cannot read the weights.*BadZipFile"),
        (lambda p: lying(p, 3 << 30), "arrays of more than 67108864 bytes"),
        (lambda p: zipped(p, {"a.npy": npy((3 << 30,), b"1234")}), "whose file is of another size"),
        (lambda p: zipped(p, {"a.npy": npy((2**40, 0), b"1234")}), "whose file is of another size"),
        (lambda p: zipped(p, {"a.npy": npy((-1, -1), b"1234")}), "whose file is of another size"),
        (lambda p: zipped(p, {"a.npy": npy((1,) * 100, b"1234")}), "cannot read the weights.*ValueError"),
        (lambda p: zipped(p, {"a.npy": npy((1,), b"12345678", "|O")}), "not plain numbers"),
        (lambda p: zipped(p, {"a.npy": npy((1,), b"12345678", "<U2")}), "not plain numbers"),
        (lambda p: zipped(p, {"a.npy": npy((1,), b"1234", [("x", "|O")])}), "not plain numbers"),
        (lambda p: zipped(p, {"a.npy": npy((1,), b"1234", version=(2, 1))}), "we only support|version"),
        (lambda p: zipped(p, {"a.npy": npy("(" * 9000, b"1234")}), "cannot read the weights"),
        (lambda p: zipped(p, {"a.npy": b"rubbish"}), "cannot read the weights"),
        (lambda p: zipped(p, {"a.npy": npy((1,), b"1234")}, zipfile.ZIP_LZMA)
            or p.write_bytes(p.read_bytes().replace(b"\x0e\x00", b"\x63\x00")), "cannot read the weights"),
        (lambda p: zipped(p, {"a.txt": b"1234"}), "no weights in the file"),
    ],
    ids=["bomb", "too short", "too long", "shape", "zeros", "negative", "axes", "objects", "texts", "records",
        "version", "deep header", "rubbish", "method", "none"],
)  # fmt: skip
def test_npz(tmp_path, write, words):
    write(tmp_path / "a.npz")
    refused(read_published, tmp_path / "a.npz", words)


def test_a_small_array_that_compresses_well_is_read(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(
        path, zeros=np.zeros((4 << 20,), np.float32), order=np.asfortranarray([[1, 2], [3, 4]])
    )
    found = read_published(path)
    assert found["zeros"].shape == (4 << 20,)
    np.testing.assert_array_equal(found["order"], [[1, 2], [3, 4]])


def test_a_directory_that_is_too_large(tmp_path, monkeypatch):
    monkeypatch.setattr(archives, "DIRECTORY_BYTES", 2000)
    for kind in (".npz", ".pth"):
        path = tmp_path / f"a{kind}"
        zipped(path, {f"{i}": b"" for i in range(50)})
        refused(read_published, path, "a directory of [0-9]+ bytes, more than 2000")


# Pickles.


def shared_tuples(levels=60):
    """A tuple of two of a tuple of two of ...: 2^60 parts, though there are 60 tuples."""
    return b")" + b"q\xffh\xff\x86" * levels


def many_views(count, size):
    one = tensor("0", (size,), (1,))
    return ordered({str(k): one for k in range(count)})


ONE = {"0": np.ones(1, np.float32).tobytes()}


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b"}" + shared_tuples() + b"K\x01s", "a key that is a tuple"),
        (b"(" + shared_tuples() + b"K\x01d", "a key that is a tuple"),
        (b"ccollections\nOrderedDict\n(" + shared_tuples() + b"tR", "a dictionary that is made of something"),
        (b"\x80\x04\x8f(" + shared_tuples() + b"\x90", "opcode EMPTY_SET, which tensors do not need"),
        (b"(" + shared_tuples() + b"\x91", "opcode FROZENSET"),
        (shared_tuples(), "no state dictionary in the file; .*found tuple"),
        (ordered({"a": shared_tuples()}), "no state dictionary in the file; .*found a$"),
        (b"]" * 5_000 + b"a" * 4_999, "no state dictionary in the file; .*found list"),
        (b"}q\x00" + plain("model") + b"h\x00s", "no state dictionary"),
        (ordered({"x" * 10**6: plain(1)}), "found xxx"),
        (b"(" + plain("a") + plain(1) + plain("b") + b"d", "shorter than|ValueError"),
        (b"\x8a\xff" + b"\x7f" * 255, "an integer of 2039 bits"),
        (b"\x82\x01", "opcode EXT1, which tensors do not need"),
        (b"\x83\x01\x00", "opcode EXT2"),
        (b"\x84\x01\x00\x00\x00", "opcode EXT4"),
        (b"\x80\x04\x8c\x05torch\x8c\x16FloatStorage.__class__\x93", r"names torch.FloatStorage.__class__"),
        (b"ctorch\nFloatStorage\n)R", "a call of something that is no function"),
        (b"ctorch\nFloatStorage\n)\x81", "opcode NEWOBJ"),
        (plain("x") + b"N" + b"R", "a call of something that is no function"),
        (b"0", "an opcode without its operand"),
        (b"(0", "an opcode without its operand"),
        (b"t", "an opcode without its mark"),
        (b"h\x07", "nothing is remembered as 7"),
        (b"Na", "an opcode without its operand|not a list"),
        (b"NN\x93", "a name that is not a text"),
        (b"\x8e\xff\xff\xff\xff\xff\xff\xff\x7f", "cannot read the weights"),
        (b"\xff", "cannot read the weights"),
    ],
)  # fmt: skip
def test_pickles(tmp_path, body, words):
    path = tmp_path / "a.pth"
    write_pth(path, body, ONE)
    refused(read_published, path, words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"size": shared_tuples(), "stride": shared_tuples()}, "impossible layout"),
        ({"size": plain((2.0,)), "stride": plain((1,))}, "impossible layout"),
        ({"size": plain((1,) * 40), "stride": plain((0,) * 40)}, "impossible layout"),
        ({"size": plain((2**62,) * 2), "stride": plain((0, 0))}, "larger than its storage"),
        ({"size": plain((1,)), "stride": plain((1,)), "offset": 2**62}, "larger than its storage"),
        ({"size": plain((1,)), "stride": plain((1,)), "key": (1, 2)}, "without a storage"),
        ({"size": plain((1,)), "stride": plain((1,)), "key": "../data.pkl/"}, "KeyError"),
    ],
)  # fmt: skip
def test_tensors(tmp_path, arguments, words):
    body = (
        b"ctorch._utils\n_rebuild_tensor_v2\n((" + plain("storage") + b"ctorch\nFloatStorage\n"
        + plain(arguments.get("key", "0")) + plain("cpu") + plain(1) + b"tQ"
        + plain(arguments.get("offset", 0)) + arguments["size"] + arguments["stride"] + b"tR"
    )  # fmt: skip
    path = tmp_path / "a.pth"
    write_pth(path, ordered({"a": body}), ONE)
    refused(read_published, path, words)


def test_many_tensors_on_one_storage(tmp_path):
    path, size = tmp_path / "a.pth", 2_500_000
    write_pth(path, many_views(300, size), {"0": bytes(4 * size)})  # 3 GB
    refused(read_published, path, "arrays of more than 67108864 bytes")
    write_pth(path, many_views(3, size), {"0": bytes(4 * size)})  # tied weights
    assert len(read_published(path)) == 3


def test_pickles_without_end(monkeypatch):
    monkeypatch.setattr(pickles, "MAX_OPCODES", 1000)
    with pytest.raises(ValueError, match="more than 1000 opcodes"):
        unpickle(b"N0" * 600 + b"N.", {}, "a")
    monkeypatch.setattr(pickles, "MAX_BYTES", 100)
    with pytest.raises(ValueError, match="a pickle of 202 bytes, more than 100"):
        unpickle(b"N0" * 100 + b"N.", {}, "a")
    with pytest.raises(ValueError, match="STOP"):
        unpickle(b"N0" * 20, {}, "a")


def test_plain_pickles_are_read():
    value = {"a": [1, 2.5, "x", b"y", None, True, ()], 3: (1, (2, 3), {"b": []}), "n": -(2**40)}
    for protocol in range(3, 6):
        assert unpickle(pickle.dumps(value, protocol), {}, "a") == value
    del value["a"][3]  # before protocol 3 bytes are a call
    for protocol in range(6):
        assert unpickle(pickle.dumps(value, protocol), {}, "a") == value
