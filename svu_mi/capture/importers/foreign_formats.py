"""Recognition of files of other tools that are not read, and the way to convert them.

A row of ``SIGNATURES`` is a pattern of the first bytes, the kind of file, and the export or command
that works. Sources: https://docs.nerf.studio/quickstart/custom_dataset.html and the documentation
of each tool; see ``notebooks/tools.md``.
"""

import re
from itertools import islice
from pathlib import Path

from svu_mi.capture import capture_folder
from svu_mi.capture.image_formats.recognition import SUFFIXES
from svu_mi.errors import CaptureError

HEAD = 4096  # bytes that are compared
LISTED = 1000  # files of a folder that are looked at
NERFSTUDIO = "ns-process-data {} of nerfstudio writes transforms.json"
RUN_COLMAP = (
    "compute poses from the photographs: colmap automatic_reconstructor --workspace_path . "
    "--image_path images, and import the folder"
)
SIGNATURES = tuple((re.compile(pattern, re.DOTALL), kind, remedy) for pattern, kind, remedy in (
    (rb"\s*(<\?xml[^>]*\?>)?\s*(<!--.*?-->\s*)*<scene\b", "a Mitsuba scene",
     "it needs no import: svu entropy SCENE.xml --images FOLDER"),
    (rb"\s*(<\?xml[^>]*\?>)?\s*<document version=",
     "a project or cameras of Metashape",
     "in Metashape, choose File > Export > Export Cameras and the type Colmap (since 2.2; before: "
     + NERFSTUDIO.format("metashape") + ")"),
    (rb"#name,x,y,|#cameras \d+\s*#name,|.*<[^>]*xcr:|<Reality(Capture|Scan)\b",
     "cameras or a project of RealityCapture",
     "in RealityScan, export the registration as COLMAP (since 2.0; before: as CSV, and "
     + NERFSTUDIO.format("realitycapture") + ")"),
    (rb'\s*\{\s*"sfm_data_version"', "a reconstruction of OpenMVG",
     "openMVG_main_openMVG2Colmap -i sfm_data.json -o FOLDER writes a COLMAP model"),
    (rb'\s*\{\s*"header"\s*:\s*\{\s*"(pipelineVersion|releaseVersion|nodesVersions)',
     "a project of Meshroom",
     "give cameras.sfm, which the node StructureFromMotion writes (right click: Open Folder)"),
    (rb"Ogawa", "an Alembic file",
     "in Meshroom, give cameras.sfm next to sfm.abc, or add the node ConvertSfMFormat with json"),
    (rb"# Bundle file v", "cameras of Bundler",
     "export a COLMAP model from the tool that wrote it (Metashape, RealityScan and Meshroom can)"),
    (rb"NVM_V3", "a model of VisualSFM", RUN_COLMAP),
    (rb'\s*\[\s*\{\s*"(cameras|biases|rig_cameras)"\s*:', "a reconstruction of OpenSfM",
     "opensfm export_colmap FOLDER writes a COLMAP model"),
    (rb'\s*\[\s*\{\s*"id"\s*:\s*\d+\s*,\s*"img_name"', "cameras of trained 3D Gaussians",
     "give the folder that they were trained from, source_path in cfg_args"),
    (rb"SQLite format 3\0", "a database of COLMAP, which has matches but no poses",
     "compute poses with colmap mapper --database_path database.db --image_path images "
     "--output_path sparse, and import the project folder"),
    (rb'\s*\{(?=.*"t_0[0-3]"\s*:)', "a keyframe of Polycam",
     NERFSTUDIO.format("polycam") + " from the export Raw Data (developer mode)"),
    (rb'\s*\{(\s*"poses"\s*:\s*\[\s*\[|(?=.*"(K|perFrameIntrinsicCoeffs)"\s*:\s*\[)'
     rb'(?!.*"(frames|train_filenames)"))', "metadata of Record3D",
     NERFSTUDIO.format("record3d") + " from the export EXR + RGB"),
    (rb"BLENDER", "a Blender scene",
     "export poses as transforms.json, for example with the add-on BlenderNeRF"),
    (rb"PK\x03\x04.{26}[^\0]{1,200}\.usd[ac]", "a model of Apple's Object Capture, without poses",
     RUN_COLMAP + "; the mesh must be in that world"),
    (rb"PK\x03\x04.{26}(?![^\0]{1,200}\.npy)", "a ZIP archive", "unpack it, and import the folder"),
))  # fmt: skip
PLACES = ("*", "images/*.xmp", "keyframes/corrected_cameras/*.json", "keyframes/cameras/*.json")


def refuse_foreign(path: Path) -> None:
    """Raise CaptureError for a file of another tool, or a folder that contains one."""
    if (path / capture_folder.FILE).is_file():
        raise CaptureError(f"{path}: was imported already; give it to other commands.")
    files = [path] if path.is_file() else [
        file for place in PLACES for file in islice(path.glob(place), LISTED) if file.is_file()
    ]  # fmt: skip
    for file in sorted(files):
        if found := _recognise(file):
            raise CaptureError(
                f"{file}: contains {found[0]}, in a format that is not read; {found[1]}."
            )
    pictures = (*files, *islice(path.glob("images/*"), LISTED))
    if any(file.suffix.lower() in SUFFIXES for file in pictures):
        raise CaptureError(f"{path}: has photographs but no poses; {RUN_COLMAP}.")


def _recognise(file: Path) -> tuple[str, str] | None:
    """Return the kind of a file of another tool, and its remedy."""
    try:
        with file.open("rb") as opened:
            head = opened.read(HEAD).removeprefix(b"\xef\xbb\xbf")
    except OSError:
        return None
    return next((row[1:] for row in SIGNATURES if row[0].match(head)), None)
