"""Models that are not there, not whole or not the right ones: one line that says what to do."""

import json
import shutil
from types import SimpleNamespace

import httpx2 as httpx
import huggingface_hub
import pytest
import torch
import transformers
from huggingface_hub.errors import (
    GatedRepoError,
    LocalEntryNotFoundError,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from model_folders import tiny

from semstab.errors import ConfigError, DataError
from semstab.models import create
from semstab.models.checkpoint import Checkpoint, ModelOptions
from semstab.models.devices import checked_device


def fails(kind, match, name="segformer", **options):
    with pytest.raises(kind, match=match) as caught:
        create(name, **options)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.fixture
def folder(tmp_path):
    """A copy of a whole model, to break."""
    return shutil.copytree(tiny("segformer"), tmp_path / "model")


def test_a_folder_that_is_not_there(tmp_path):
    fails(
        DataError,
        r"nowhere: there is no such folder; name one that save_pretrained wrote",
        checkpoint=str(tmp_path / "nowhere"),
    )


def test_a_folder_without_a_model(tmp_path):
    fails(DataError, "holds no config.json, so no model", checkpoint=str(tmp_path))


def test_a_model_without_weights(folder):
    (folder / "model.safetensors").unlink()
    fails(DataError, "holds no weights", checkpoint=str(folder))


def test_damaged_weights(folder):
    weights = folder / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    fails(DataError, "AutoModelForSemanticSegmentation cannot load it", checkpoint=str(folder))


def test_a_damaged_configuration(folder):
    (folder / "config.json").write_text("{")
    fails(DataError, "cannot load it", checkpoint=str(folder))


def test_damaged_preprocessing(folder):
    (folder / "preprocessor_config.json").write_text("{")
    fails(DataError, r"preprocessor_config\.json: ", checkpoint=str(folder))
    (folder / "preprocessor_config.json").write_text("[1]")
    fails(DataError, "is no JSON object", checkpoint=str(folder))
    (folder / "preprocessor_config.json").write_text('{"image_processor_type": 1}')
    fails(DataError, "AutoImageProcessor cannot load it", checkpoint=str(folder))


def test_a_model_of_another_kind():
    fails(
        DataError,
        "a 'clip' model does not segment into classes; name one of: .*segf.*eomt",
        checkpoint=str(tiny("clip")),
    )
    fails(DataError, "AutoModelForMaskGeneration cannot load it", "sam-raw", checkpoint=str(tiny("segformer")))
    fails(
        DataError,
        "weights are missing, .*: it was not trained as CLIPModel",
        "segearth-ov",
        checkpoint=str(tiny("sam")),
    )


def test_weights_that_are_missing_are_not_made_up(folder):
    """A classifier's checkpoint loads as a segmenter, with a random head, unless one looks."""
    config = transformers.SegformerConfig.from_pretrained(folder)
    transformers.SegformerForImageClassification(config).save_pretrained(folder)
    message = "weights are missing, among them decode_head.*: it was not trained as SegformerForSemanticSegmentation"
    fails(DataError, message, checkpoint=str(folder))


def test_weights_of_other_shapes(folder):
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"decoder_hidden_size": 24}))
    fails(DataError, "AutoModelForSemanticSegmentation cannot load it", checkpoint=str(folder))


def test_a_folder_has_no_revision(folder):
    fails(ConfigError, "a folder has no revision 'main'", checkpoint=str(folder), revision="main")


@pytest.mark.parametrize("device", ["cuda:99", "tpu"])
def test_a_device_that_is_not_there(folder, device):
    fails(
        ConfigError, rf"^device {device}: torch cannot use it \(.*\); use cpu$", checkpoint=str(folder), device=device
    )


def test_a_gpu_computes_in_full_precision(monkeypatch):
    """Reduced precision flips labels; no GPU is needed to see what is set."""
    monkeypatch.setattr(torch, "empty", lambda *size, device: None)
    cudnn, matmul = torch.backends.cudnn, torch.backends.cuda.matmul
    before = cudnn.allow_tf32, matmul.allow_tf32
    try:
        cudnn.allow_tf32 = matmul.allow_tf32 = True
        checked_device("cpu")
        assert (cudnn.allow_tf32, matmul.allow_tf32) == (True, True)
        checked_device("cuda")
        assert (cudnn.allow_tf32, matmul.allow_tf32) == (False, False)
    finally:
        cudnn.allow_tf32, matmul.allow_tf32 = before


def test_unknown_options_and_values(folder):
    fails(
        ConfigError,
        r"^model 'segformer': unknown setting 'chekpoint'; did you mean 'checkpoint'\?$",
        checkpoint="m",
        chekpoint="m",
    )
    fails(ConfigError, "^model 'segformer': dtype: ", checkpoint=str(folder), dtype="float8")
    fails(ConfigError, r"^model 'segfomer' is not known; did you mean 'segformer'\?$", "segfomer", checkpoint="m")


# --- The hub ----------------------------------------------------------------------------------------------------------


def no_cache(*arguments, **options):
    raise LocalEntryNotFoundError("nothing here")


def answer(status, kind):
    response = httpx.Response(status, request=httpx.Request("GET", "https://hub.invalid"))
    return kind("no", response=response)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ConnectionError("[Errno -2] Name or service not known"), r"the hub cannot be reached .*hf download a/model"),
        (answer(404, RepositoryNotFoundError), "no such model on the hub; correct the name"),
        (answer(404, RevisionNotFoundError), "the hub has no revision 'v2' of it"),
        (answer(403, GatedRepoError), "its owner asks for consent"),
    ],
)
def test_the_hub_says_no(monkeypatch, error, message):
    def model_info(*arguments, **options):
        raise error

    monkeypatch.setattr(huggingface_hub, "snapshot_download", no_cache)
    monkeypatch.setattr(huggingface_hub.HfApi, "model_info", model_info)
    fails(DataError, message, checkpoint="a/model", revision="v2")


def test_a_model_in_the_cache_needs_no_network(monkeypatch, tmp_path):
    cached = shutil.copytree(tiny("segformer"), tmp_path / "0123abc")

    def snapshot_download(name, *, revision, local_files_only):
        assert (name, revision, local_files_only) == ("a/model", None, True)
        return str(cached)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    found = Checkpoint.find(ModelOptions(checkpoint="a/model"))
    assert (found.revision, found.title) == ("0123abc", "a/model")


def test_a_part_of_a_model_in_the_cache_is_completed(monkeypatch, tmp_path):
    part, whole = tmp_path / "part", shutil.copytree(tiny("segformer"), tmp_path / "5678def")
    part.mkdir()

    def snapshot_download(name, *, revision, local_files_only=False, allow_patterns=None):
        assert local_files_only or (revision, allow_patterns) == ("5678def", ["*.json", "*.txt", "*.bin"])
        return str(part if local_files_only else whole)

    files = [SimpleNamespace(rfilename=name) for name in ("config.json", "pytorch_model.bin", "tf_model.h5")]
    about = SimpleNamespace(sha="5678def", siblings=files)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    monkeypatch.setattr(huggingface_hub.HfApi, "model_info", lambda self, name, **options: about)
    assert Checkpoint.find(ModelOptions(checkpoint="a/model")).revision == "5678def"
