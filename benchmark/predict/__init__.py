"""Running segmentation models: over a sequence to label maps on disk, or inside a run with nothing on disk."""

from semstab.predict.live import PredictedDataset, predicted_config
from semstab.predict.predictor import PredictorConfig, load_predictor, parse_predictor
from semstab.predict.sequence import PredictionObserver, SequenceOptions, SequenceReport, predict_sequence
from semstab.predict.sources import ImageFiles, ImageScene, ImageSequence, open_images

__all__ = [
    "ImageFiles",
    "ImageScene",
    "ImageSequence",
    "PredictedDataset",
    "PredictionObserver",
    "PredictorConfig",
    "SequenceOptions",
    "SequenceReport",
    "load_predictor",
    "open_images",
    "parse_predictor",
    "predict_sequence",
    "predicted_config",
]
