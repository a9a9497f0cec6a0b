"""Archives of sequences (round trip within the stated errors, damage, size) and the data-set script."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments import make_datasets as md
from jaxsr.errors import JaxsrError
from jaxsr.io import archive
from jaxsr.io.archive_coding import decode_plane, encode_plane, quantise_normal, restore_normal
from jaxsr.io.exr import read_exr, write_exr
from jaxsr.io.sequence import Sequence, SequenceWriter
from jaxsr.io.writing import FrameInfo
from jaxsr.progress import Bars

SIZE = (16, 8)


def camera_matrix(i: int) -> np.ndarray:
    a = 0.02 * i
    matrix = np.eye(4)
    matrix[:3, :3] = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
    matrix[:3, 3] = (0.1 * i, 0.0, 0.05 * i)
    return matrix


def layers(rng: np.random.Generator, h: int, w: int) -> dict[str, np.ndarray]:
    """All layers, with sky in a corner; values a renderer would give."""
    normal = rng.normal(size=(h, w, 3))
    out = {
        "color": rng.lognormal(0, 2, (h, w, 3)),
        "reference": rng.lognormal(0, 1, (h, w, 3)),
        "depth": np.exp(rng.uniform(-1, 5, (h, w, 1))),
        "motion": rng.uniform(-20, 20, (h, w, 2)),
        "normal": normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        "base_color": rng.uniform(0, 1, (h, w, 3)),
        "roughness": rng.uniform(0, 1, (h, w, 1)),
        "metallic": rng.integers(0, 2, (h, w, 1)).astype(float),
        "object_id": rng.integers(1, 3000, (h, w, 1)).astype(float),
    }
    out["depth"][:2, :3] = np.inf
    for name in ("normal", "base_color", "roughness", "metallic", "object_id"):
        out[name][:2, :3] = 0
    return {name: x.astype(np.float32) for name, x in out.items()}


def write_sequence(
    folder: Path, name: str = "bunker-train-0", frames: int = 3, size=SIZE, reference: bool = True
) -> Path:
    rng = np.random.default_rng(0)
    w, h = size
    notes = {"tool": "test", "samples": 4, "denoise": False, "seed": 0, "blender": "5.0.1"}
    with SequenceWriter(
        folder, name=name, size=size, scales=(2,), license="CC0-1.0", generator=notes
    ) as writer:
        for i in range(1, frames + 1):
            info = FrameInfo(
                i,
                (0.25, -0.125 * i),
                i == 1,
                camera_matrix(i),
                (0.6, 0.34),
                (0.1, 0.0),
                hr_jitter_px=(0.125 * i, 0.5),
            )
            low = layers(rng, h // 2, w // 2)
            del low["reference"]
            high = layers(rng, h, w)
            if not reference:
                del high["reference"]
            writer.write_frame(info, high, {2: low})
    return folder


@pytest.fixture
def packed(tmp_path):
    source = write_sequence(tmp_path / "source" / "train" / "bunker-train-0")
    file = tmp_path / "shelf" / "data.jsrz"
    archive.pack({"train/bunker-train-0": source}, file)
    return source, file


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    cosine = (a * b).sum(-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def test_round_trip_within_the_stated_errors(packed, tmp_path):
    source, file = packed
    manifest = archive.read_manifest(file)
    archive.verify(file)
    out = archive.unpack_sequence(file, manifest, "train/bunker-train-0", tmp_path / "out")
    a, b = Sequence.open(source), Sequence.open(out)
    assert (a.size, a.scales, a.name, a.license, a.exposure) == (
        b.size,
        b.scales,
        b.name,
        b.license,
        b.exposure,
    )
    assert b.generator["samples"] == 4
    assert "quantised" in b.generator
    for i in range(len(a)):
        assert a.infos[i].to_json() == b.infos[i].to_json()
        fa, fb = a.frame(i, 2), b.frame(i, 2)
        pairs = [(a.truth(i, name), b.truth(i, name)) for name in ("color", "reference")]
        for x, y in (*pairs, (fa.color_linear, fb.color_linear)):
            np.testing.assert_allclose(y, x, rtol=2.0**-6 * 1.01, atol=1e-6)
        for x, y in ((fa.lr, fb.lr), (fa.hr, fb.hr)):
            sky = ~np.isfinite(x.depth_linear[..., 0])
            np.testing.assert_array_equal(sky, ~np.isfinite(y.depth_linear[..., 0]))
            octaves = np.log(150 / 0.3)
            np.testing.assert_allclose(
                y.depth_linear[~sky], x.depth_linear[~sky], rtol=octaves / 131068 + 1e-6
            )
            assert np.abs(y.motion_px - x.motion_px).max() <= 1 / 128 + 1e-5
            assert angle(x.normal[~sky], y.normal[~sky]).max() < 0.95
            assert not y.normal[sky].any()
            step = np.abs(srgb(x.base_color) - srgb(y.base_color)).max()
            assert step <= 0.5 / 255 + 1e-3
            assert np.abs(x.roughness - y.roughness).max() <= 1 / 510 + 1e-3
            np.testing.assert_array_equal(x.metallic, y.metallic)
            np.testing.assert_array_equal(x.object_id, y.object_id)


def srgb(x: np.ndarray) -> np.ndarray:
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def test_ten_bits_of_colour_are_lossless_and_fewer_keep_55_db(tmp_path):
    source = write_sequence(tmp_path / "source", frames=1)
    before, _ = read_exr(source / "hr" / "0001.exr")
    psnr = {}
    for bits in (10, 5):
        file = tmp_path / f"{bits}.jsrz"
        archive.pack({"s": source}, file, color_bits=bits)
        out = archive.unpack_sequence(file, archive.read_manifest(file), "s", tmp_path / str(bits))
        after, _ = read_exr(out / "hr" / "0001.exr")
        a, b = (np.stack([c[f"color.{k}"] for k in "RGB"], -1).astype(np.float32) for c in (before, after))
        psnr[bits] = np.inf if (a == b).all() else md.floor_psnr(a, b, 1.0) - 10 * np.log10(2)
    assert psnr[10] == np.inf
    assert 55 < psnr[5] < 70


@given(
    st.sampled_from([(1, 1), (1, 7), (5, 1), (6, 9)]),
    st.sampled_from(["u1", "u2", "u4"]),
    st.integers(0, 2**31),
)
def test_planes_are_coded_without_loss(shape, dtype, seed):
    high = 2 ** (8 * np.dtype(dtype).itemsize)
    plane = np.random.default_rng(seed).integers(0, high, shape, dtype=dtype)
    plane[0, 0] = high - 1
    note, blob = encode_plane(plane)
    np.testing.assert_array_equal(decode_plane(note, blob, shape), plane)


def test_octahedral_normals_everywhere():
    n = np.random.default_rng(0).normal(size=(100, 100, 3))
    n[:6, 0] = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    back = restore_normal(quantise_normal(n), np.zeros(n.shape[:2], bool))
    assert angle(n, back).max() < 0.95
    assert angle(n[:6, 0], back[:6, 0]).max() < 0.01
    np.testing.assert_allclose(np.linalg.norm(back, axis=-1), 1, atol=1e-6)


def test_archives_are_deterministic_and_checked(packed, tmp_path):
    source, file = packed
    again = tmp_path / "again.jsrz"
    archive.pack({"train/bunker-train-0": source}, again)
    assert again.read_bytes() == file.read_bytes()
    beside = file.with_name("data.jsrz.sha256")
    assert beside.read_text().split() == [archive.file_digest(file), "data.jsrz"]

    manifest = archive.read_manifest(file)
    damaged = tmp_path / "damaged.jsrz"
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(damaged, "w") as new:
        for name in old.namelist():
            blob = bytearray(old.read(name))
            if name.endswith("x2/0002"):
                blob[-1] ^= 1
            new.writestr(name, bytes(blob))
    with pytest.raises(JaxsrError, match="x2/0002' is damaged"):
        archive.unpack_sequence(damaged, manifest, "train/bunker-train-0", tmp_path / "out")
    assert [i.index for i in Sequence.open(tmp_path / "out").infos] == [1], "frames before it are whole"
    archive.unpack_sequence(file, manifest, "train/bunker-train-0", tmp_path / "out")
    assert len(Sequence.open(tmp_path / "out")) == 3, "resumes"
    damaged.rename(file)
    with pytest.raises(JaxsrError, match="checksum does not match"):
        archive.verify(file)
    file.write_bytes(b"something else")
    with pytest.raises(JaxsrError, match="not an archive"):
        archive.read_manifest(file)


def description(**changes: object) -> dict:
    head = {"format": "jaxsr-sequence", "version": 1, "size": [4, 2], "scales": [2], "frames": [{}]}
    return head | changes


def write_manifest(file: Path, manifest: object) -> Path:
    with zipfile.ZipFile(file, "w") as out:
        out.writestr("manifest.json", json.dumps(manifest))
    return file


@pytest.mark.parametrize(
    "name",
    ["../../evil", "/evil", "train/../../evil", "C:\\evil", "\\\\host\\evil", "..\\evil", "C:evil", ""],
)
def test_names_that_lead_out_of_the_folder_are_refused(tmp_path, name):
    head = {"format": archive.FORMAT, "version": archive.VERSION, "members": {}}
    file = write_manifest(tmp_path / "a.jsrz", head | {"sequences": {name: description()}})
    with pytest.raises(JaxsrError, match="unsafe name of a sequence"):
        archive.read_manifest(file)
    assert md.main(["unpack", str(tmp_path / "out"), "--archive", str(file)]) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["a.jsrz"]


def test_damaged_manifests_and_checksums(tmp_path):
    head = {"format": archive.FORMAT, "version": archive.VERSION, "members": {}}
    for manifest, words in [
        ([], r"manifest\.json: bad JSON; expected an object .*; found list"),
        ({"format": "x"}, "another kind of archive"),
        (head, 'damaged manifest; expected "sequences"'),
        (head | {"sequences": []}, 'damaged manifest; expected "sequences"'),
        (head | {"sequences": {"a": []}}, r"a\.jsrz, a: not a sequence"),
        (head | {"sequences": {"a": description(size=[1])}}, r"a\.jsrz, a: bad size"),
    ]:
        with pytest.raises(JaxsrError, match=words):
            archive.read_manifest(write_manifest(tmp_path / "a.jsrz", manifest))
    file = write_manifest(tmp_path / "a.jsrz", head | {"sequences": {"a": description(frames=[{}])}})
    with pytest.raises(JaxsrError, match=r"a\.jsrz, a: entry 0 of frames is not right.*missing 'index'"):
        archive.unpack_sequence(file, archive.read_manifest(file), "a", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (tmp_path / "a.jsrz.sha256").write_text("")
    with pytest.raises(JaxsrError, match="checksum does not match"):
        archive.verify(tmp_path / "a.jsrz")


def test_packing_removes_what_a_killed_one_left(tmp_path):
    source = write_sequence(tmp_path / "source", frames=1)
    (tmp_path / "shelf").mkdir()
    (tmp_path / "shelf" / ".docks.jsrz.9999999-1.tmp").write_bytes(b"half")
    (tmp_path / "shelf" / ".mine.tmp").write_bytes(b"not ours")
    archive.pack({"s": source}, tmp_path / "shelf" / "a.jsrz")
    found = sorted(p.name for p in (tmp_path / "shelf").iterdir())
    assert found == [".mine.tmp", "a.jsrz", "a.jsrz.sha256"]


def test_archive_of_limited_size(tmp_path):
    source = write_sequence(tmp_path / "source")
    with pytest.raises(JaxsrError, match=r"grows too large.*at most 0\.001 MB.*--color-bits"):
        archive.pack({"s": source}, tmp_path / "a.jsrz", max_megabytes=0.001)
    assert [p.name for p in tmp_path.iterdir()] == ["source"], "nothing half-written"


# --- the script ------------------------------------------------------------------------------------------


def lay_references(shelf: Path, source: Path, indices) -> None:
    """References beside an archive, as files of their own."""
    folder = shelf / "reference" / "train" / "bunker-train-0"
    folder.mkdir(parents=True)
    for i in indices:
        image = Sequence.open(source).truth(i - 1)[::-1] * 0.25
        write_exr(folder / f"{i:04d}.exr", {f"reference.{c}": image[..., k] for k, c in enumerate("RGB")})


@pytest.mark.parametrize("indices", [(1, 2, 3), (1, 3)])
def test_references_beside_an_archive_are_joined_where_no_frame_lacks_one(tmp_path, indices):
    source = write_sequence(tmp_path / "source" / "train" / "bunker-train-0", reference=False)
    file = tmp_path / "shelf" / "train.jsrz"
    archive.pack({"train/bunker-train-0": source}, file)
    lay_references(file.parent, source, indices)
    assert md.main(["unpack", str(tmp_path / "out"), "--archive", str(file)]) == 0
    (found,) = (tmp_path / "out").rglob("sequence.json")
    seq = Sequence.open(found.parent)
    assert ["reference" in seq.layers("hr", i) for i in range(3)] == [len(indices) == 3] * 3
    if len(indices) == 3:
        expected = Sequence.open(source).truth(1)[::-1] * 0.25
        np.testing.assert_allclose(seq.truth(1, "reference"), expected, rtol=2e-3, atol=1e-4)
    assert seq.infos[1].hr_jitter_px == (0.25, 0.5)


def test_noise_floors_of_both_truths_are_kept_apart(tmp_path, monkeypatch):
    """Two renders that differ by d everywhere have a floor of 10 log10(2 / d^2)."""
    asked = []

    def colors(config, clip, truth, seed, folder, tick):
        asked.append((truth, clip.name, seed))
        high = {"color": 1e-3, "reference": 2e-3}[truth] * (seed == 2)
        described = {"samples": 4, "reference": 9, "denoise": False, "bounces": 1, "exposure": 1.0}
        return {f: np.full((2, 2, 3), high, np.float32) for f in config.frames}, described | {
            "blender": "5",
            "scene_sha256": "0",
        }

    monkeypatch.setattr(md, "_colors", colors)
    monkeypatch.setattr(md, "to_display", lambda image, exposure: image)
    results = tmp_path / "floors.json"
    config = md.Floor(scenes=("docks",), splits=("test",), frames=(8,), seeds=(1, 2), results=results)
    with Bars(quiet=True) as bars:
        md.measure_floor(replace(config, truths=("color",)), bars)
        md.measure_floor(replace(config, truths=("reference",)), bars)
    assert asked == [(truth, "docks-test-0", seed) for truth in ("color", "reference") for seed in (1, 2)]
    found = {truth: entries["docks-test-0"] for truth, entries in json.loads(results.read_text()).items()}
    assert {truth: (e["psnr_db"], e["samples"]) for truth, e in found.items()} == {
        "color": (63.01, 4),
        "reference": (56.99, 9),
    }


def test_sets_share_no_clip_and_interleave_scenes():
    train, test = (md.clips_of(md.Render(set=s)) for s in ("train", "test"))
    assert {c.split for c in train} == {"train"}
    assert {c.split for c in test} == {"test"}
    assert sum(c.frames for c in train) == 180
    assert [c.scene for c in train[:4]] == ["bunker", "forest", "docks", "bunker"]
    assert sum(c.frames for c in md.clips_of(md.Render(set="sample"))) == 33
    few = md.clips_of(md.Render(set="train", scenes=("forest",), clips=2, frames=3))
    assert [(c.name, c.frames) for c in few] == [("forest-train-0", 3), ("forest-train-1", 3)]


def test_render_takes_what_an_archive_has_and_needs_no_blender(packed, tmp_path, monkeypatch):
    _, file = packed
    monkeypatch.setenv("JAXSR_BLENDER", "nowhere")
    monkeypatch.setattr(md, "SHARED", tmp_path / "no shared folder")
    config = md.Render(
        set="train", scenes=("bunker",), clips=1, frames=3, size=SIZE, scales=(2,), out=tmp_path / "out"
    )
    with pytest.raises(JaxsrError, match="JAXSR_BLENDER"):
        md.render_set(config, Bars(quiet=True))
    monkeypatch.setattr(md, "SHARED", file.parent)
    md.render_set(config, Bars(quiet=True))
    seq = Sequence.open(tmp_path / "out" / "train" / "bunker-train-0")
    assert len(seq) == 3
    monkeypatch.setattr(md, "SHARED", tmp_path / "no shared folder")
    md.render_set(config, Bars(quiet=True))  # complete: nothing to do


def test_another_seed_is_neither_complete_nor_taken_from_an_archive(packed, tmp_path, monkeypatch):
    source, file = packed
    clip = md.Clip("bunker", "train", 0, 3)
    config = md.Render(set="train", size=SIZE, scales=(2,), search=file)
    monkeypatch.setattr(md, "SHARED", tmp_path / "none")
    assert md.is_complete(source, clip, config)
    for other in (replace(config, seed=1), replace(config, samples=5)):
        assert not md.is_complete(source, clip, other)
        assert not md.from_archive(other, clip, tmp_path / "out")
    assert md.from_archive(config, clip, tmp_path / "out")


def test_a_render_killed_between_a_frame_and_its_entry_is_not_complete(packed, tmp_path):
    source, _ = packed
    head = json.loads((source / "sequence.json").read_text())
    (source / "sequence.json").write_text(json.dumps(head | {"frames": head["frames"][:2]}))
    with pytest.raises(JaxsrError, match="not in sequence"):
        Sequence.open(source)
    config = md.Render(set="train", size=SIZE, scales=(2,))
    assert not md.is_complete(source, md.Clip("bunker", "train", 0, 3), config)
    assert not md.is_complete(source, md.Clip("bunker", "train", 0, 2), config)
    write_sequence(source)  # what the renderer does: it resumes
    assert md.is_complete(source, md.Clip("bunker", "train", 0, 3), config)


def test_a_failed_floor_keeps_the_log_that_it_names(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(md, "CACHE", tmp_path / "cache")
    program = tmp_path / "blender"
    program.write_text(
        '#!/bin/sh\n[ "$1" = --version ] && echo Blender 5.0.1 && exit\necho out of memory >&2\nexit 1\n'
    )
    program.chmod(0o755)
    assert md.main(["floor", "--blender", str(program), "--results", str(tmp_path / "floors.json")]) == 2
    message = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(message) == 1, "one line"
    log = Path(message[0].split("see ")[1])
    assert "out of memory" in message[0]
    assert log.read_text() == "out of memory\n"
    assert not (tmp_path / "floors.json").exists()


def test_budget_ends_before_the_next_clip(tmp_path, monkeypatch):
    monkeypatch.setattr(md, "SHARED", tmp_path)
    config = md.Render(set="test", budget_minutes=0.0, out=tmp_path / "out")
    md.render_set(config, Bars(quiet=True))
    assert not list(tmp_path.rglob("*.exr"))


def test_floor_estimates_the_noise_of_one_render():
    """Two renders = truth + independent noise: the floor is the PSNR of one of them against the truth."""
    rng = np.random.default_rng(0)
    truth = np.full((200, 200, 3), 0.18, np.float32)
    a, b = (truth + rng.normal(0, 0.002, truth.shape).astype(np.float32) for _ in range(2))
    one_sided = md.floor_psnr(a, truth, 1.0) - 10 * np.log10(
        2
    )  # undo the halving: plain PSNR against the truth
    assert abs(md.floor_psnr(a, b, 1.0) - one_sided) < 0.1


def test_pack_unpack_and_card_from_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(md, "SHARED", tmp_path / "shared")
    write_sequence(tmp_path / "data" / "train" / "bunker-train-0")
    write_sequence(tmp_path / "data" / "test" / "docks-test-0", "docks-test-0")
    md.add_cost(tmp_path / "data" / "test" / "docks-test-0" / "render.json", 10.0, 20.0)
    md.add_cost(tmp_path / "data" / "test" / "docks-test-0" / "render.json", 2.5, 3.0)
    file = tmp_path / "shared" / "all.jsrz"
    assert md.main(["pack", str(tmp_path / "data"), str(file)]) == 0
    assert md.main(["unpack", str(tmp_path / "out")]) == 0
    found = sorted(
        p.parent.relative_to(tmp_path / "out").as_posix() for p in (tmp_path / "out").rglob("sequence.json")
    )
    assert found == ["test/docks-test-0", "train/bunker-train-0"]
    assert md.main(["unpack", str(tmp_path / "out"), "--search", str(tmp_path / "nowhere")]) == 2

    floors = tmp_path / "floors.json"
    entry = {"psnr_db": 41.5, "samples": 64, "frames": {"1": 41.5}, "size": [384, 216]}
    other = entry | {"psnr_db": 39.2, "samples": 128, "frames": {"8": 39.2}}
    floors.write_text(json.dumps({"color": {"docks-test-0": entry}, "reference": {"docks-test-0": other}}))
    arguments = ["--out", str(tmp_path / "data"), "--floors", str(floors), "--docs", str(tmp_path / "docs")]
    assert md.main(["card", *arguments]) == 0
    card = (tmp_path / "docs" / "data_card.md").read_text()
    assert "| test | docks-test-0 | 3 | 16x8 | x2 | 4 | no |" in card
    assert "| color | docks-test-0 | 64 | 41.5 | 1: 41.5 | 384x216 |" in card
    assert "| reference | docks-test-0 | 128 | 39.2 | 8: 39.2 | 384x216 |" in card
    assert "| docks | 32 | 64 | 128 |" in card, "samples of the references"
    assert "12 CPU seconds (1 sequences" in card
    assert "bias of the denoiser" in card
    assert (tmp_path / "docs" / "images" / "data_test.png").is_file()
    assert md.main(["card", "--out", str(tmp_path / "nothing")]) == 2
