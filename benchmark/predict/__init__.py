"""Running segmentation models: over a sequence to label maps on disk, or inside a run with nothing on disk."""

from semstab.predict.live import PredictedDataset
from semstab.predict.predictor import PredictorConfig, load_predictor, parse_predictor
from semstab.predict.sequence import PredictionObserver, SequenceOptions, SequenceReport, predict_sequence
from semstab.predict.sources import ImageFiles, ImageSequence

__all__ = [
    "ImageFiles",
    "ImageSequence",
    "PredictedDataset",
    "PredictionObserver",
    "PredictorConfig",
    "SequenceOptions",
    "SequenceReport",
    "load_predictor",
    "parse_predictor",
    "predict_sequence",
]
