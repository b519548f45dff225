"""The output of each kind of checkpoint for images: one value a class and pixel, the largest of which is the label."""

from __future__ import annotations

import contextlib
import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import torch
import transformers
from transformers import AutoModelForSemanticSegmentation, AutoModelForUniversalSegmentation, AutoTokenizer
from transformers.models.auto.modeling_auto import MODEL_FOR_SEMANTIC_SEGMENTATION_MAPPING_NAMES as SEMANTIC

from semstab.core.files import atomic_path, cache_folder, content_key
from semstab.errors import ConfigError, DataError, MissingDependencyError, summarize_error
from semstab.models import Image
from semstab.models.checkpoint import Checkpoint, ModelOptions, SegmenterOptions, bilinear, load_processor

logger = logging.getLogger("semstab")

MULTIPLE = 32
"""Images are brought to multiples of this, the stride of the deepest features."""

SQUARE = ("dpt", "tipsv2_dpt", "data2vec-vision")
"""Kinds whose code takes square images only."""


# Each head is a loaded checkpoint. `names`: its classes in the order of its maps. `maps(images)`: (K, h, w) of each
# image, of whatever size. `softmax`: whether scores are the softmax of the maps, else each map's share of their sum.


class SemanticHead:
    """Logits of each class: SegFormer, BEiT, DPT, UPerNet, ..., run by torch or by ONNX Runtime."""

    softmax = True

    def __init__(self, checkpoint: Checkpoint, options: SegmenterOptions, kind: str) -> None:
        self._options = options
        self._processor = load_processor(checkpoint, options.processor)
        model = checkpoint.load_model(AutoModelForSemanticSegmentation, options)
        self.names: Mapping[int, str] = model.config.id2label
        self._size = _square(kind, model.config, self._processor, options) if kind in SQUARE else options.image_size
        self.engine: Callable[[torch.Tensor], torch.Tensor] = (
            OnnxEngine(model, options, checkpoint.revision)
            if options.engine == "onnx"
            else lambda pixels: model(pixel_values=pixels.to(model.device, model.dtype)).logits
        )
        self._kind = kind

    def maps(self, images: Sequence[Image]) -> list[torch.Tensor]:
        """Return the logits.

        Raises:
            ConfigError: If the model cannot see images of that size.
        """
        shorter = self._size or _shorter_side(self._processor)
        height, width = shorter if isinstance(shorter, tuple) else working_size(images[0].shape[:2], shorter)
        pixels = self._processor(
            images=list(images),
            size={"height": height, "width": width},
            input_data_format="channels_last",
            return_tensors="pt",
        )["pixel_values"]
        try:
            return list(self.engine(pixels))
        except RuntimeError as error:
            if "out of memory" in str(error):
                raise
            raise ConfigError(
                f"image_size: a '{self._kind}' model cannot see {height}x{width} ({summarize_error(error)});"
                f" give the size"
                " that it was made for"
            ) from error


class UniversalHead:
    """Masks with classes: each class has the sum over all masks of class probability times mask probability.

    Mask2Former, MaskFormer, OneFormer (asked for semantic segmentation), EoMT (whose windows are averaged).
    """

    KINDS: ClassVar = ("mask2former", "maskformer", "oneformer", "eomt", "eomt_dinov3")

    softmax = False

    MASKS: ClassVar = {"mask2former": (384, 384)}
    """The size to which transformers brings masks before they are added up."""

    def __init__(self, checkpoint: Checkpoint, options: SegmenterOptions, kind: str) -> None:
        more = {"class_info_file": None} if kind == "oneformer" else {}  # it would be fetched, for training only
        self._processor = load_processor(checkpoint, options.processor, **more)
        self._model = checkpoint.load_model(AutoModelForUniversalSegmentation, options)
        self.names: Mapping[int, str] = self._model.config.id2label
        self._task = None
        if kind == "oneformer":
            task: Any = checkpoint.load(AutoTokenizer)(
                "the task is semantic", padding="max_length", max_length=self._model.config.task_seq_len,
                truncation=True, return_tensors="pt",
            )  # fmt: skip
            self._task = task["input_ids"] * task["attention_mask"]
        self._windows = kind.startswith("eomt")
        self._size: dict[str, Any] = {}  # the checkpoint's own
        if options.image_size is not None and self._windows:
            raise ConfigError(
                f"image_size: an '{kind}' model sees windows of the size that it was made for; leave it out"
            )
        if isinstance(options.image_size, int):
            self._size = {"size": {"shortest_edge": options.image_size, "longest_edge": 4 * options.image_size}}
        elif options.image_size is not None:
            self._size = {"size": dict(zip(("height", "width"), options.image_size, strict=True))}
        size = self._processor.size
        self._masks = self.MASKS.get(kind)
        if self._windows:
            self._masks = (size["shortest_edge"], size.get("longest_edge") or size["shortest_edge"])

    def maps(self, images: Sequence[Image]) -> list[torch.Tensor]:
        """Return the sums."""
        settings = {"images": list(images), "input_data_format": "channels_last", "return_tensors": "pt", **self._size}
        if self._task is not None:
            settings["task_inputs"] = ["semantic"] * len(images)
        inputs = self._processor(**settings)
        arguments = {"pixel_values": inputs["pixel_values"].to(self._model.device, self._model.dtype)}
        if self._task is not None:
            arguments["task_inputs"] = self._task.expand(len(images), -1)
        if "pixel_mask" in inputs:
            arguments["pixel_mask"] = inputs["pixel_mask"].to(self._model.device)
        output = self._model(**arguments)
        sums = [
            class_sums(classes, masks, self._masks)
            for classes, masks in zip(output.class_queries_logits, output.masks_queries_logits, strict=True)
        ]
        if self._windows and len(inputs["patch_offsets"]):
            return _merged(sums, inputs, images)
        if self._windows and self._processor.do_pad:  # transformers would stretch the padding over the image, too
            height, width = self._processor(**settings, do_pad=False)["pixel_values"].shape[-2:]
            return [class_maps[:, :height, :width] for class_maps in sums]
        return sums


class PromptedHead:
    """CLIPSeg: a logit of each prompt, which stand in `prompts` (Lüddecke and Ecker 2022, CVPR)."""

    softmax = True

    def __init__(self, checkpoint: Checkpoint, options: SegmenterOptions, kind: str) -> None:
        from transformers import CLIPSegForImageSegmentation

        if not options.prompts:
            raise ConfigError("a 'clipseg' model needs prompts; set prompts: [road, building, ...]")
        if options.image_size is not None and not isinstance(options.image_size, int):
            raise ConfigError("image_size: a 'clipseg' model sees squares; give one number")
        self.names: Mapping[int, str] = dict(enumerate(options.prompts))
        self._processor = load_processor(checkpoint, options.processor)
        self._model = checkpoint.load_model(CLIPSegForImageSegmentation, options)
        tokens = checkpoint.load(AutoTokenizer)(list(options.prompts), padding=True, return_tensors="pt")
        with torch.inference_mode():
            self._prompts = self._model.get_conditional_embeddings(
                len(options.prompts), **{key: value.to(self._model.device) for key, value in tokens.items()}
            )
        side = options.image_size or self._processor.size["height"]
        self._seen = {"size": {"height": side, "width": side}}

    def maps(self, images: Sequence[Image]) -> list[torch.Tensor]:
        """Return the logits."""
        settings = {"images": list(images), "input_data_format": "channels_last", "return_tensors": "pt", **self._seen}
        pixels = self._processor(**settings)["pixel_values"].to(self._model.device, self._model.dtype)
        K, more = len(self._prompts), {"conditional_embeddings": self._prompts, "interpolate_pos_encoding": True}
        logits = [self._model(pixel_values=image.expand(K, -1, -1, -1), **more).logits for image in pixels]
        return [logit.reshape(K, *logit.shape[-2:]) for logit in logits]


Head = SemanticHead | UniversalHead | PromptedHead


def load_head(checkpoint: Checkpoint, options: SegmenterOptions, kind: str) -> Head:
    """Load a kind of checkpoint.

    Raises:
        DataError: For another one, with the kinds that there are.
    """
    if kind in SEMANTIC:
        return SemanticHead(checkpoint, options, kind)
    if options.engine != "torch":
        raise ConfigError(f"engine {options.engine} cannot run a '{kind}' model; leave it out")
    if kind in UniversalHead.KINDS:
        return UniversalHead(checkpoint, options, kind)
    if kind == "clipseg":
        return PromptedHead(checkpoint, options, kind)
    kinds = ", ".join((*SEMANTIC, *UniversalHead.KINDS, "clipseg"))
    raise DataError(f"{checkpoint.folder}: a '{kind}' model does not segment into classes; name one of: {kinds}")


def class_sums(classes: torch.Tensor, masks: torch.Tensor, size: tuple[int, int] | None) -> torch.Tensor:
    """Return (K, h, w): over queries q of softmax(classes)[q, k] times sigmoid(masks)[q], without the class 'none'.

    Args:
        classes: (Q, K + 1) logits, 'none' last.
        masks: (Q, h', w') logits.
        size: (h, w) that the masks are brought to first, None to leave them.
    """
    masks = masks.float() if size is None else bilinear(masks.float(), size)
    return torch.einsum("qk,qhw->khw", classes.float().softmax(dim=-1)[:, :-1], masks.sigmoid())


def working_size(image: tuple[int, ...], shorter: int) -> tuple[int, int]:
    """Return (height, width) of the image's shape whose shorter side is about that long, in multiples of 32 pixels.

    >>> working_size((1080, 1920), 512)
    (512, 896)
    """
    scale = shorter / min(image)
    height, width = (max(MULTIPLE, round(side * scale / MULTIPLE) * MULTIPLE) for side in image)
    return height, width


def _square(kind: str, config: Any, processor: Any, options: SegmenterOptions) -> tuple[int, int]:
    """Return the side of the square that the model sees; an image is squeezed into it, which is reported."""
    stated, made_for = options.image_size, getattr(config, "image_size", None) or _shorter_side(processor)
    side = made_for if stated is None else stated if isinstance(stated, int) else stated[0]
    if isinstance(stated, tuple) and stated[0] != stated[1]:
        raise ConfigError(f"image_size: a '{kind}' model sees squares; give one number, {made_for} for example")
    if getattr(processor, "keep_aspect_ratio", None):
        processor.keep_aspect_ratio = False
    logger.warning("a '%s' model sees squares: images are squeezed into %dx%d", kind, side, side)
    return side, side


def _shorter_side(processor: Any) -> int:
    """Return the shorter side, in pixels, of the images that the checkpoint was made for."""
    size = processor.size
    return int(size.get("shortest_edge") or min(size["height"], size["width"]))


def _merged(sums: Sequence[torch.Tensor], inputs: Any, images: Sequence[Image]) -> list[torch.Tensor]:
    """Return windows along the longer side put together, averaged where they overlap."""
    offsets = [[int(value) for value in offset] for offset in inputs["patch_offsets"]]
    merged = []
    for k, image in enumerate(images):
        tall = image.shape[0] > image.shape[1]
        windows = [(start, end, sums[n]) for n, (which, start, end) in enumerate(offsets) if which == k]
        K, h, w = windows[0][2].shape
        length = max(end for _, end, _ in windows)
        total = torch.zeros(K, *((length, w) if tall else (h, length)))
        count = torch.zeros(total.shape[1:])
        for start, end, window in windows:
            area = (slice(start, end), slice(None)) if tall else (slice(None), slice(start, end))
            total[:, *area] += window.cpu()
            count[area] += 1
        merged.append(total / count)
    return merged


# ONNX Runtime instead of torch: the same model, exported once for each image size and stored.

INSTALL = "pip install 'semstab[onnx]'"


class OnnxEngine:
    """Pixels (N, 3, h, w) to logits (N, K, h', w') on the CPU in float32, an image at a time.

    The export of this version of the model is stored in the cache folder, if the folder can be written to.

    Raises:
        ConfigError: For another device or dtype.
        MissingDependencyError: Without onnxruntime.
    """

    def __init__(self, model: torch.nn.Module, options: ModelOptions, revision: str) -> None:
        if options.device != "cpu" or options.dtype != "float32":
            raise ConfigError(
                f"engine onnx runs on the cpu in float32, not on {options.device} in {options.dtype}; use engine torch"
            )
        try:
            import onnxruntime
            import onnxscript  # noqa: F401  torch's exporter needs it
        except ImportError as error:
            raise MissingDependencyError(f"engine onnx cannot be used ({summarize_error(error)}); {INSTALL}") from error
        self._settings = onnxruntime.SessionOptions()
        self._settings.log_severity_level = 3
        if options.threads is not None:
            self._settings.intra_op_num_threads = options.threads
        self._model = _Logits(model)
        self._revision = revision
        self._sessions: dict[tuple[int, ...], Any] = {}

    def __call__(self, pixels: torch.Tensor) -> torch.Tensor:
        """Return logits of the images.

        Raises:
            DataError: For a model that cannot be exported.
        """
        shape = tuple(pixels.shape[1:])
        if shape not in self._sessions:
            self._sessions[shape] = self._session(pixels[:1])
        session = self._sessions[shape]
        logits = [session.run(None, {"pixels": pixels[k : k + 1].numpy()})[0] for k in range(len(pixels))]
        return torch.cat([torch.from_numpy(array) for array in logits])

    def _session(self, example: torch.Tensor) -> Any:
        import onnxruntime

        versions = {"torch": torch.__version__, "transformers": transformers.__version__}
        key = content_key({"revision": self._revision, "shape": list(example.shape), **versions})
        file = cache_folder() / "onnx" / f"{key}.onnx"
        settings = {"sess_options": self._settings, "providers": ["CPUExecutionProvider"]}
        with contextlib.suppress(Exception):  # it is not there, or damaged
            return onnxruntime.InferenceSession(file, **settings)
        content = _export(self._model, example)
        with contextlib.suppress(OSError), atomic_path(file) as temporary:
            temporary.write_bytes(content)
        return onnxruntime.InferenceSession(content, **settings)


class _Logits(torch.nn.Module):
    """The model with one tensor in and one out, as an export needs it."""

    def __init__(self, model: torch.nn.Module) -> None:
        super().__init__()
        self.model = model
        self.eval()

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        logits: torch.Tensor = self.model(pixel_values=pixels).logits
        return logits


def _export(model: torch.nn.Module, example: torch.Tensor) -> bytes:
    notes = logging.getLogger("torch.onnx")
    level = notes.level
    notes.setLevel(logging.ERROR)  # it notes that torchvision is missing, which nothing here needs
    try:
        with warnings.catch_warnings(), torch.inference_mode(False):
            warnings.filterwarnings("ignore", message=".*LeafSpec.* is deprecated", category=FutureWarning)
            program = torch.onnx.export(
                model, (example.clone(),), input_names=["pixels"], output_names=["logits"], verbose=False
            )
        assert program is not None
        content: bytes = program.model_proto.SerializeToString()
    except Exception as error:  # the exporter's own; and those of protobuf about more than 2 GB
        raise DataError(f"the model cannot be exported to ONNX ({summarize_error(error)}); use engine torch") from error
    finally:
        notes.setLevel(level)
    return content
