"""Exports to S3, against moto's server on this machine."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.export.run import store as storeexport

pytest.importorskip("moto", reason="moto (an S3 server for tests) is not installed")
pytest.importorskip("s3fs", reason="s3fs is not installed")

KEYS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_DEFAULT_REGION": "us-east-1"}
SMALL = "[camera]\nwidth_px = 64\nheight_px = 48\nfx_px = 60.0\nfy_px = 60.0\n[exposure]\nduration_s = 0.1\n"


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Start a server with the bucket ``night``, and return a file system of it."""
    import s3fs  # noqa: PLC0415 - may be missing
    from moto.server import ThreadedMotoServer  # noqa: PLC0415 - may be missing

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    for name, value in (KEYS | {"AWS_ENDPOINT_URL": f"http://{host}:{port}"}).items():
        monkeypatch.setenv(name, value)
    for name in ("AWS_PROFILE", "AWS_SESSION_TOKEN", "HTTP_PROXY", "http_proxy"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    try:
        files = s3fs.S3FileSystem(skip_instance_cache=True)
        files.mkdir("night")
        yield files
    finally:
        server.stop()
        s3fs.S3FileSystem.clear_instance_cache()


def export(folder: Path, output: str) -> str:
    config = folder / "small.toml"
    config.write_text(SMALL)
    words = ["export", "-o", output, "-c", str(config), "--frames", "6", "--workers", "1"]
    result = CliRunner().invoke(app, words)
    return f"{result.exit_code} {' '.join(result.output.split())}"


def test_an_export_to_s3_goes_on_after_an_interruption(
    tmp_path: Path, bucket: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks of 2 frames; stopped before the lines of the second block are sent, then continued."""
    make, send = storeexport.StoreExport.__init__, storeexport.ObjectStore.send
    monkeypatch.setattr(storeexport.StoreExport, "__init__", lambda self, job, url: make(self, job, url, 2))

    def torn(self: storeexport.ObjectStore, name: str, content: bytes) -> None:
        if name == "truth-000001.jsonl":
            raise KeyboardInterrupt
        send(self, name, content)

    with monkeypatch.context() as patched:
        patched.setattr(storeexport.ObjectStore, "send", torn)
        assert export(tmp_path, "s3://night/one").startswith("130 ")
    assert "4 frames drawn in" in export(tmp_path, "s3://night/one")
    assert export(tmp_path, str(tmp_path / "local")).startswith("0 ")

    sent = {path.removeprefix("night/one/"): bucket.cat_file(path) for path in bucket.find("night/one")}
    local = {path.name: path.read_bytes() for path in (tmp_path / "local").iterdir() if not path.name.startswith(".")}
    assert sent == local
    assert len(local) == 8, "6 images, manifest and truth"

    missing = export(tmp_path, "s3://no-such-bucket/one")
    assert missing.startswith("1 glstar: s3://no-such-bucket/one: cannot be written (")
    assert "AWS_ACCESS_KEY_ID" in missing
