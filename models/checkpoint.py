"""Pretrained models from a folder or from the hub: located, loaded whole, or one error with the remedy."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import huggingface_hub
import torch
import transformers
from huggingface_hub.errors import GatedRepoError, HFValidationError, RepositoryNotFoundError, RevisionNotFoundError
from pydantic import Field, PositiveInt, field_validator
from transformers import AutoImageProcessor, SegformerImageProcessorPil

from semstab.config import Settings
from semstab.core.files import read_json
from semstab.errors import ConfigError, DataError, MissingDependencyError
from semstab.models import sides
from semstab.models.devices import checked_device, first_sentence

if not transformers.is_torch_available():  # else its classes are stand-ins that fail when they are used
    raise ImportError(f"transformers {transformers.__version__} does not work with torch {torch.__version__}")

HUB_ID = re.compile(r"[\w-][\w.-]*(/[\w-][\w.-]*)?")
WEIGHTS = ("*.safetensors", "*.bin")
"""Suffixes of weights, the preferred first."""

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
HUB_TIMEOUT = 10.0


class ModelOptions(Settings):
    """The settings that name a pretrained model and say how it runs."""

    checkpoint: str = Field(description="a folder that save_pretrained wrote, or an id on the Hugging Face hub")
    revision: str | None = Field(None, description="branch, tag or commit on the hub; the newest by default")
    device: str = Field("cpu", description="cpu, cuda, cuda:1, mps")
    dtype: Literal["float32", "bfloat16", "float16"] = Field(
        "float32", description="of the computation; lower precision flips labels, which counts as flicker"
    )
    threads: int | None = Field(None, ge=1, description="threads on a CPU; torch's own number by default")

    def identity(self) -> dict[str, Any]:
        """Return the options that its output depends on; the model itself is named by `Checkpoint.revision`."""
        return self.model_dump(mode="json", exclude={"checkpoint", "revision", "threads"})


@dataclass(frozen=True)
class Checkpoint:
    """The files of one version of a model.

    Attributes:
        name: The folder, or the id on the hub.
        folder: The folder of the files.
        revision: The commit on the hub, or the digest of the files.
    """

    name: str
    folder: Path
    revision: str

    @property
    def title(self) -> str:
        """The hub id, or the folder's own name."""
        return self.folder.name if self.name == str(self.folder) else self.name

    @classmethod
    def find(cls, options: ModelOptions) -> Checkpoint:
        """Look in the file system, then in the hub's cache, then on the hub.

        Raises:
            DataError: If the model is in none of them.
            ConfigError: For a name that is no model's.
        """
        folder = Path(options.checkpoint).expanduser()
        if folder.is_dir():
            if options.revision is not None:
                raise ConfigError(f"{folder}: a folder has no revision '{options.revision}'; leave it out")
            _require_model(folder)
            return cls(str(folder), folder, _digest(folder))
        if not HUB_ID.fullmatch(options.checkpoint) or folder.exists():
            raise DataError(f"{folder}: there is no such folder; name one that save_pretrained wrote, or a hub id")
        fetched = _cached(options) or _download(options)
        return cls(options.checkpoint, fetched, fetched.name)

    def preprocessing(self) -> dict[str, Any]:
        """Return the content of preprocessor_config.json, empty without the file.

        Raises:
            DataError: If it is damaged.
        """
        file = self.folder / "preprocessor_config.json"
        if not file.is_file():
            return {}
        content = read_json(file)
        if not isinstance(content, dict):
            raise DataError(f"{file}: is no JSON object; {AGAIN}")
        return content

    def load(self, loader: Any, **options: Any) -> Any:
        """Return the result of `loader.from_pretrained` on the folder, without network.

        Raises:
            DataError: If it makes nothing.
        """
        with _quiet():
            try:
                return loader.from_pretrained(self.folder, local_files_only=True, **options)
            except Exception as error:  # the loaders raise whatever their parsers do
                what = loader.__name__
                raise DataError(f"{self.folder}: {what} cannot load it ({first_sentence(error)}); {AGAIN}") from error

    def load_model(self, loader: Any, options: ModelOptions) -> Any:
        """Return a model on its device, ready to predict.

        Raises:
            DataError: If weights are missing or have other shapes.
            ConfigError: For a device that is not there.
        """
        device = checked_device(options.device)
        if options.threads is not None:
            torch.set_num_threads(options.threads)
        model, info = self.load(loader, dtype=DTYPES[options.dtype], output_loading_info=True)
        unusable = [*info["missing_keys"], *(str(key) for key in info["mismatched_keys"])]
        if unusable:
            raise DataError(
                f"{self.folder}: {len(unusable)} weights are missing, among them {min(unusable)}:"
                f" it was not trained as {type(model).__name__}; choose another model"
            )
        return model.to(device).eval()


AGAIN = "name a folder that save_pretrained wrote, or a hub id, of such a model"


def bilinear(images: torch.Tensor, size: Any) -> torch.Tensor:
    """Return images (K, h, w) brought to (K, H, W), pixel areas aligned."""
    return torch.nn.functional.interpolate(images[None], size=size, mode="bilinear", align_corners=False)[0]


def _require_model(folder: Path) -> None:
    if not (folder / "config.json").is_file():
        raise DataError(f"{folder}: holds no config.json, so no model; name a folder that save_pretrained wrote")
    if not any(path for pattern in WEIGHTS for path in folder.glob(pattern)):
        raise DataError(f"{folder}: holds no weights (model.safetensors); copy them into it")


def _digest(folder: Path) -> str:
    """Return the hash of the names and contents of the files that loading may read."""
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted(folder.iterdir()):
        if path.suffix in (".json", ".txt", ".safetensors", ".bin") and path.is_file():
            digest.update(path.name.encode() + b"\0")
            with path.open("rb") as file:
                digest.update(hashlib.file_digest(file, "blake2b").digest())
    return digest.hexdigest()


def _cached(options: ModelOptions) -> Path | None:
    """Return the folder of the hub's cache, where an earlier download left the whole model there."""
    try:
        folder = Path(
            str(huggingface_hub.snapshot_download(options.checkpoint, revision=options.revision, local_files_only=True))
        )
        _require_model(folder)
    except (OSError, ValueError):  # DataError is a ValueError: a part of a model
        return None
    return folder


def _download(options: ModelOptions) -> Path:
    name, revision = options.checkpoint, options.revision
    try:
        # Asked first, because it fails at once without a network; the download would try for half a minute.
        about = huggingface_hub.HfApi().model_info(name, revision=revision, timeout=HUB_TIMEOUT)
        files = [sibling.rfilename for sibling in about.siblings or ()]
        weights = next((pattern for pattern in WEIGHTS if any(Path(file).match(pattern) for file in files)), WEIGHTS[0])
        patterns = ["*.json", "*.txt", weights]
        folder = Path(huggingface_hub.snapshot_download(name, revision=about.sha, allow_patterns=patterns))
    except GatedRepoError as error:
        raise DataError(
            f"model '{name}': its owner asks for consent; give it on the hub, then 'hf auth login'"
        ) from error
    except (RepositoryNotFoundError, HFValidationError) as error:
        raise DataError(
            f"model '{name}': there is no such folder, and no such model on the hub; correct the name"
        ) from error
    except RevisionNotFoundError as error:
        raise DataError(
            f"model '{name}': the hub has no revision '{revision}' of it; correct it, or leave it out"
        ) from error
    except Exception as error:  # no network has many faces
        raise DataError(
            f"model '{name}': there is no such folder, it is not in the hub's cache, and the hub cannot be reached"
            f" ({first_sentence(error)}); with a network, run 'hf download {name} --local-dir FOLDER', then name the"
            " folder"
        ) from error
    _require_model(folder)
    return folder


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the progress bar and the notes of transformers, which would break into our own."""
    notes: Any = transformers.utils.logging
    verbosity, bars = notes.get_verbosity(), notes.is_progress_bar_enabled()
    notes.set_verbosity_error()
    notes.disable_progress_bar()
    try:
        yield
    finally:
        notes.set_verbosity(verbosity)
        if bars:
            notes.enable_progress_bar()


# A checkpoint's own preprocessing, which makes the images that the model was trained on.

Processing = Literal["pil", "torchvision"]


class ImageModelOptions(ModelOptions):
    """The settings that name a pretrained model, say how it runs, and which library resizes images for it."""

    processor: Processing = Field(
        "pil", description="pil or torchvision: they resize differently, which changes up to 2 % of the labels"
    )


def load_processor(checkpoint: Checkpoint, processing: Processing, **settings: Any) -> Any:
    """Return the checkpoint's own preprocessing, without a crop, done by the library that is asked for and no other.

    Checkpoints of before transformers 5 may name a 'feature extractor' that is no longer there.

    Raises:
        ConfigError: If that library is not installed.
        DataError: If the checkpoint's preprocessing cannot be done by it.
    """
    if processing == "torchvision" and importlib.util.find_spec("torchvision") is None:
        raise MissingDependencyError(
            "processor: torchvision is not installed; leave it out, or pip install 'semstab[torchvision]'"
        )
    preprocessing = checkpoint.preprocessing()
    kind = preprocessing.get("image_processor_type") or preprocessing.get("feature_extractor_type")
    if processing == "pil" and kind == "SegformerFeatureExtractor":
        processor = checkpoint.load(SegformerImageProcessorPil, **settings)
    else:
        processor = checkpoint.load(AutoImageProcessor, backend=processing, **settings)
    if type(processor).__name__.endswith("Pil") != (processing == "pil"):
        other = "torchvision" if processing == "pil" else "pil"
        raise DataError(
            f"{checkpoint.folder}: its {type(processor).__name__} cannot do its work by {processing}; set processor:"
            f" {other}"
        )
    if getattr(processor, "do_center_crop", None):
        processor.do_center_crop = False
    return processor


# Settings of the model `transformers`.


class SegmenterOptions(ImageModelOptions):
    """The settings of a segmenter: checkpoint, image size, engine and prompts."""

    image_size: PositiveInt | tuple[PositiveInt, PositiveInt] | None = Field(
        None,
        description="the shorter side in pixels, at the shape of the image; or [height, width]; by default the one that"
        " the checkpoint was trained with",
    )
    engine: Literal["torch", "onnx"] = Field("torch", description="torch, or ONNX Runtime on the CPU")
    prompts: tuple[str, ...] | None = Field(None, description="of a CLIPSeg model: its prompts, which are its classes")
    threshold: float | None = Field(
        None, gt=0, lt=1, description="of a CLIPSeg model: pixels at which every prompt is less likely are ignored"
    )

    _sides = field_validator("image_size", mode="before")(sides)

    @field_validator("prompts", mode="before")
    @classmethod
    def _listed(cls, value: Any) -> Any:
        return [part.strip() for part in value.split(",")] if isinstance(value, str) else value
