"""``svu``: files and status 0 on valid input, one line and status 2 on bad input."""

from __future__ import annotations

import json
import re

import drjit as dr
import pytest
import tyro
from support.helpers import (
    fails,
    names,
    overlapping_balls,
    run,
    sensor_xml,
    write_older,
    write_scene,
)

from svu_mi import _llvm, scenes
from svu_mi.cli import main
from svu_mi.cli.help import REGISTRY
from svu_mi.core.io.exr import read_exr
from svu_mi.errors import SvuError

FILES = ["coverage.exr", "entropy.exr", "overview.png", "run.json"]


pytestmark = pytest.mark.usefixtures("variant")  # svu selects a variant


def test_render_writes_a_capture_folder(shot):
    written = [name for name in names(shot) if name != "cache"]  # of commands in other tests
    assert written == ["capture.json"] + [f"view_{i:04d}.exr" for i in range(8)]
    record = json.loads((shot / "capture.json").read_text())
    assert record["define"] == {"light": "window"}
    assert record["shape"] == "vase"
    image = read_exr(shot / "view_0003.exr")
    assert set(image) == set("RGBA")
    assert image["R"].shape == (32, 40)


def test_entropy_writes_four_files(shot, tmp_path, capsys):
    assert run("entropy", shot, "-o", tmp_path, "--resolution", 64, 32, "-t", 2) == 0
    told = capsys.readouterr().out.splitlines()[-1]
    assert names(tmp_path) == FILES
    entropy = read_exr(tmp_path / "entropy.exr")
    coverage = read_exr(tmp_path / "coverage.exr")
    assert list(entropy) == list(coverage) == ["Y"]
    assert entropy["Y"].shape == (32, 64)
    assert (entropy["Y"] >= 0).all()
    assert (entropy["Y"] <= 1).all()
    assert (entropy["Y"][coverage["Y"] == 0] == 1).all()
    assert coverage["Y"].max() <= 8
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["settings"]["preset"]["name"] == "default"
    assert record["environment"]["variant"].endswith("_ad_rgb")
    version = ".".join(map(str, dr.detail.llvm_version()))
    assert record["environment"]["llvm"] == {"version": version, "source": _llvm.status().source}
    assert record["timings_s"]
    assert record["skipped"]["views left out"] == 0
    known = record["result"]["intervals"]["known_part"]
    words = [f"{name} {part}" for name, part in zip(
        ("Roughness known to ±0.05 on", "of the surface area seen, metallic on", "base colour on"),
        ("under 1 %" if 0 < part <= 0.005 else f"{100 * part:.0f} %" for part in known.values()),
        strict=True,
    )]  # fmt: skip
    summary, _, told = told.partition(". ")
    assert told == f"{words[0]} {words[1]}, {words[2]} (90 % intervals of 64×32 texels)."
    assert re.fullmatch(r"\d+ % of the surface area seen, mean entropy 0\.\d\d", summary)


def test_result_as_capture_is_refused_with_its_source(tmp_path, capsys):
    result = tmp_path / "result"
    write_older(result, "recover", "run.json", ["base_color.exr"])
    words = ("entropy", result, "-o", tmp_path / "out")
    assert fails(capsys, *words) == (
        f"svu: {result}: is a result of svu recover; give the capture it was computed from."
    )
    record = json.loads((result / "run.json").read_text())
    record["inputs"] = {"source": "shots/vase"}
    (result / "run.json").write_text(json.dumps(record))
    assert fails(capsys, *words).endswith("; give the capture it was computed from (shots/vase).")
    record["settings"] = {"given": {"scene": "my scene/a.xml", "images": "my scene/shots"}}
    (result / "run.json").write_text(json.dumps(record))
    line = fails(capsys, *words)
    assert line.endswith(" from ('my scene/a.xml' --images 'my scene/shots').")


@pytest.mark.parametrize(
    "command", ["entropy", *(pytest.param(c, marks=pytest.mark.slow) for c in ("recover", "guide"))]
)
def test_results_are_not_written_among_the_files_of_the_scene(tmp_path, capsys, command):
    scene = write_scene(tmp_path)
    shot = tmp_path / "shot"
    assert run("render", scene, "--spp", 1, "-o", shot) == 0
    before = names(tmp_path)
    for given in ((shot,), (scene,), (scene, "--render"), (scene, "--images", shot)):
        capsys.readouterr()
        line = fails(capsys, command, *given, "-o", tmp_path)
        assert line.startswith(
            f"svu: {tmp_path}: contains other files: ball.ply was not written by"
        )
    line = fails(capsys, command, shot, "-o", shot)
    assert line == (
        f"svu: {shot}: contains other files: capture.json was written by svu render; choose "
        "another name, or --overwrite, which keeps this one as shot.before."
    )
    assert names(tmp_path) == before


def test_scene_is_rendered_only_with_option_render(tmp_path, capsys):
    path = write_scene(tmp_path, sensors=sensor_xml(4, 32, 32))
    words = ("entropy", path, "-o", tmp_path / "out", "--resolution", 24)
    line = fails(capsys, *words)
    assert line == (
        f"svu: {path}: no photographs next to it; give their folder with --images, or --render to "
        "render the scene itself (4 sensors)."
    )
    assert run(*words, "--render", "--spp", 2) == 0
    assert (tmp_path / "out" / "capture" / "view_0003.exr").exists()
    assert (tmp_path / "out" / "entropy.exr").exists()
    line = fails(capsys, *words, "--render", "--images", tmp_path)
    assert line == "svu: --render has no effect with --images; omit one of them."
    line = fails(capsys, "entropy", tmp_path / "out" / "capture", "--render", "-o", tmp_path / "o")
    assert "--render takes a Mitsuba scene (.xml)" in line


def test_60_photographs_of_100_sensors(tmp_path, capsys):
    """In this test, 3 of 5."""
    path = write_scene(tmp_path, sensors=sensor_xml(5, 32, 32))
    photographs, out = tmp_path / "photographs", tmp_path / "out"
    assert run("render", path, "--spp", 2, "-o", photographs) == 0
    for number in (1, 4):
        (photographs / f"view_000{number}.exr").unlink()
    words = ("entropy", photographs, "-o", out, "--resolution", 24)
    assert fails(capsys, *words) == (
        f"svu: {photographs}: 2 of 5 photographs are missing, first view_0001.exr; add "
        "them, or continue without them by --missing leave-out."
    )
    assert run(*words, "--missing", "leave-out") == 0
    record = json.loads((out / "run.json").read_text())["inputs"]
    assert record["left_out"] == ["view_0001.exr", "view_0004.exr"]


@pytest.mark.filterwarnings("default::svu_mi.errors.SvuWarning")
def test_overlapping_uvs_are_unwrapped_with_option_unwrap(tmp_path, capsys):
    path = write_scene(tmp_path, sensors=sensor_xml(3, 32, 32), **overlapping_balls())
    words = ["entropy", path, "-o", tmp_path / "out", "--resolution", 32, "--render", "--spp", 1]
    assert "--unwrap" in fails(capsys, *words)
    assert run(*words, "--unwrap") == 0


def test_python_scripts_find_every_name():
    import svu_mi as svu

    for name in svu.__all__:
        assert getattr(svu, name) is not None


def test_bad_input_is_one_line_and_status_2(shot, tmp_path, capsys):
    out = tmp_path / "out"
    assert "no such file" in fails(capsys, "entropy", tmp_path / "no.xml", "-o", out)
    line = fails(capsys, "entropy", scenes.path("vase"), "--images", tmp_path / "x", "-o", out)
    assert "no such folder" in line
    assert "KEY=VALUE" in fails(capsys, "render", scenes.path("vase"), "-D", "light", "-o", out)
    line = fails(capsys, "render", scenes.path("vase"), "-D", "light=moon", "-o", out)
    assert "vase.xml" in line
    line = fails(capsys, "entropy", shot, "--shape", "jug", "-o", out)
    assert re.search("no shape 'jug'.*vase", line)
    line = fails(capsys, "entropy", shot, "--resolution", 0, "-o", out)
    assert "--resolution" in line
    assert "-1" in fails(capsys, "entropy", shot, "-t", -1, "-o", out)
    assert "in [0, 1024]" in fails(capsys, "entropy", shot, "-t", 100000, "-o", out)
    assert "$parallel" in fails(capsys, "entropy", shot, "-D", "parallel=0", "-o", out)
    assert "seed" in fails(capsys, "render", scenes.path("vase"), "--seed", -1, "-o", out)


def test_invalid_options_fail_before_photographs_are_read(tmp_path, capsys, monkeypatch):
    """The scene does not exist, so it cannot have been loaded."""
    words = (tmp_path / "no.xml", "-o", tmp_path / "out")
    line = fails(capsys, "entropy", *words, "--method", "spectrum", "--preset", "fixed")
    assert line == (
        "svu: Unknown preset 'fixed'; method 'spectrum' has default, fast, paper. "
        "For 'fixed', use method 'angular'."
    )
    assert fails(capsys, "entropy", *words, "-m", "cuda") == (
        "svu: This Mitsuba has no variant 'cuda'; omit -m, or use cuda_ad_rgb or llvm_ad_rgb."
    )
    monkeypatch.setattr("drjit.has_backend", lambda backend: backend.name != "CUDA")
    assert fails(capsys, "entropy", *words, "-m", "cuda_ad_rgb") == (
        "svu: Variant cuda_ad_rgb needs a GPU, and Dr.Jit found none; omit -m, or run svu doctor."
    )


def test_scene_without_sensors_names_the_remedy(tmp_path, capsys):
    path = write_scene(tmp_path, sensors="")
    for command, remedy in (
        ("entropy", "render some with svu render --views N"),
        ("check", "render some with svu render --views N"),
        ("guide", "render some with svu render --views N"),
        ("render", "pass --views N to place some"),
    ):
        assert fails(capsys, command, path, "-o", tmp_path / command) == (
            f"svu: {path}: the scene has no sensor; add one <sensor> per photograph, or {remedy}."
        )


@pytest.mark.parametrize("command", ["entropy", "recover", "guide", "report", "check"])
def test_memory_is_announced_before_any_pixel_is_read(shot, tmp_path, capsys, monkeypatch, command):
    monkeypatch.setattr("svu_mi.capture.photographs._read_photograph", None)
    monkeypatch.setattr("svu_mi.core.memory.free_memory", lambda: 10**11)
    words = (command, shot, "-o", tmp_path / "out.html")
    with pytest.raises(TypeError):  # the patched reader fails
        run(*words, "-v")
    told = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"Needs up to [.\d]+ GB of memory; \d+ GB available", told[0])


@pytest.mark.parametrize("name", ["scalar_rgb", "llvm_ad_spectral", "nonsense_rgb"])
def test_a_variant_that_cannot_run_is_named(shot, tmp_path, capsys, name):
    assert name in fails(capsys, "entropy", shot, "-m", name, "-o", tmp_path)


def test_an_output_folder_that_cannot_be_written(shot, tmp_path, capsys):
    blocker = tmp_path / "file"
    blocker.write_text("")
    assert "is a file" in fails(capsys, "entropy", shot, "-o", blocker)
    assert str(blocker) in fails(capsys, "entropy", shot, "-o", blocker / "below")


def test_verbose_shows_the_traceback(tmp_path):
    with pytest.raises(SvuError):
        run("entropy", tmp_path / "no.xml", "-v", "-o", tmp_path / "out")


@pytest.mark.slow
def test_demo_leaves_four_files(tmp_path, capsys):
    assert run("demo", "-o", tmp_path, "--spp", 1, "--resolution", 32) == 0
    told = capsys.readouterr().out.splitlines()[-1]
    assert re.match(
        r"\d+ % of the surface area seen, mean entropy 0\.\d\d\. Roughness known to ±0\.05 on .* "
        r"of the surface area seen, .* intervals of 32×32 texels\)\.$", told
    )  # fmt: skip
    assert names(tmp_path) == sorted(["capture", *FILES])
    assert "capture.json" in names(tmp_path / "capture")


COMMANDS = list(main.COMMANDS)


def test_typing_errors_are_answered_for_the_same_command(capsys):
    assert fails(capsys, "entrpy", "a.xml") == "svu: entrpy: no such command; did you mean entropy?"
    wrong = {
        "--imagse=b": "--imagse: no such option of svu entropy; did you mean --images?",
        "--zzz": "--zzz: no such option of svu entropy; svu entropy --help lists all.",
        "b.xml": "b.xml: svu entropy takes no such argument; svu entropy --help lists all.",
    }
    for word, sentence in wrong.items():
        assert fails(capsys, "entropy", "a.xml", word) == f"svu: {sentence}"
    assert fails(capsys) == "svu: svu --help lists the commands."


def test_a_message_names_the_working_directory(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert fails(capsys, "check", ".").startswith(f"svu: {tmp_path}: neither a Mitsuba XML scene")


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        ("guide a.xml --distance far", "--distance takes FLOAT"),
        ("import a --mesh-up w", "--mesh-up takes {y,z}"),
        ("entropy a.xml --resolution 64.5", "--resolution takes SIZE | WIDTH HEIGHT"),
        ("import a --flash 1 2 --mesh b.ply", "--flash takes X Y Z"),
        ("recover a -o", "--output takes FOLDER"),
        ("compare a", "svu compare needs A B"),
        ("relight a", "svu relight needs CAPTURE | SCENE.xml --recovered FOLDER"),
    ],
)
def test_a_wrong_value_is_one_sentence(words, problem, capsys):
    command = words.partition(" ")[0]
    assert fails(capsys, *words.split()) == f"svu: {problem}; svu {command} --help explains it."


def help_of(command, width, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(width))
    assert run(*command, "--help") == 0
    return capsys.readouterr().out


@pytest.mark.few(1)
@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)], ids=str)
def test_help_can_be_read_in_a_narrow_window(command, monkeypatch, capsys):
    """Lines fit the window, and words and option types are intact."""
    wide = help_of(command, 500, monkeypatch, capsys)
    assert "None}" not in wide
    words = set(re.split(r"[\s,]+", wide))
    for width in (60, 80):
        narrow = help_of(command, width, monkeypatch, capsys)
        assert max(map(len, narrow.splitlines())) <= width
        assert set(re.split(r"[\s,]+", narrow)) <= words | {""}


def option_entries(shown):
    """Return the flags of each option of a help text, with its text."""
    lists = re.sub(r"\n\n\S[^\n]*:(?=\n  )", "", shown[shown.index(":\n  ") :])
    pairs = re.findall(r"^  (\S.*?)(?:  +|\n {24})(\S.*(?:\n {24}.*)*)", lists, re.M)
    return {flags: " ".join(text.split()) for flags, text in pairs}


@pytest.mark.parametrize("command", COMMANDS)
def test_help_lists_every_option_with_text_and_default(command, monkeypatch, capsys):
    entries = option_entries(help_of([command], 80, monkeypatch, capsys))
    with pytest.raises(SystemExit):
        tyro.cli(
            main.COMMANDS[command], args=["--help"], registry=REGISTRY,
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.AvoidSubcommands),
        )  # fmt: skip
    listed = re.findall(r"^[ │]{1,3}(-.*?)(?:  |│)", capsys.readouterr().out, re.M)
    parsed = {flag for flags in listed for flag in re.findall(r"--\w[\w-]+", flags)} - {"--help"}
    options = {flag for flags in entries for flag in re.findall(r"--[\w-]+", flags)}
    assert options <= parsed
    assert {flag.replace("--no-", "--") for flag in parsed} <= options
    for flags, text in entries.items():
        assert re.search(r"\w.*\.$", text) and "None" not in text, flags
        is_switch = flags.startswith("-") and " " not in flags.split(", ")[-1]
        assert is_switch or re.search("default|required|repeat|needs", text, re.I), flags


@pytest.mark.parametrize("command", COMMANDS)
def test_help_begins_with_ten_options_at_most(command, monkeypatch, capsys):
    shown = help_of([command], 80, monkeypatch, capsys)
    if command != "doctor":
        assert 2 <= len(option_entries(shown[: shown.index("\n\n", shown.index(":\n  "))])) <= 10
