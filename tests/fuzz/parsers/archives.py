"""Archives of runs: ZIP files from other people, unpacked into a new folder."""

import hashlib
import io
import json
import tempfile
import zipfile
from pathlib import Path

from cosim.studies.run_archive import MANIFEST, unpack
from tests.fuzz.harness import refusal, workspace

_NAMES = ("scenario.toml", "record/plant_step.parquet", "../evil", "loops/a/summary.json", "a\\b")


def _zip(files: dict[str, bytes], *, valid: bool = True, kind: int = zipfile.ZIP_STORED) -> bytes:
    entries = {
        name: {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        for name, content in files.items()
    }
    manifest = {
        "format": "noack run archive 1", "scenario": "a", "kind": "simulated",
        "files": entries if valid else {},
    }  # fmt: skip
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", kind) as file:
        for name, content in {MANIFEST: json.dumps(manifest).encode(), **files}.items():
            file.writestr(zipfile.ZipInfo(name), content)
    return buffer.getvalue()


SEEDS = [
    _zip({"scenario.toml": b"", "summary.json": b"{}"}),
    _zip({"scenario.toml": b"x" * 50}, valid=False),
    *(_zip({name: b"content"}) for name in _NAMES),
    b"PK\x05\x06" + bytes(18),
]
WORDS = [b"PK\x01\x02", b"PK\x03\x04", b"PK\x05\x06", MANIFEST.encode(), b"../", b"sha256"]


def one_input(data: bytes) -> None:
    with tempfile.TemporaryDirectory(dir=workspace()) as place:
        path, folder = Path(place, "a.zip"), Path(place, "inner", "out")
        path.write_bytes(data)
        with refusal((f"{path}: ", f"{folder}: ")):
            manifest = unpack(path, folder)
            written = {one for one in folder.rglob("*") if one.is_file()}
            assert written == {folder / name for name in manifest.files}
        inside = {path, folder.parent, *folder.parent.rglob("*")}
        assert set(Path(place).rglob("*")) <= inside, "a file outside the folder"
