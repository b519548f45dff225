"""A network of one convolution for TensorFlow Lite, written with the schema that LiteRT brings, without a converter."""

from __future__ import annotations

from pathlib import Path

import flatbuffers
import numpy as np
from ai_edge_litert import schema_py_generated as schema

WEIGHTS = np.random.default_rng(0).normal(size=(4, 3, 3, 3)).astype(np.float32)
"""(K, 3, 3, 3): classes, rows, columns, channels."""

BIAS = np.array([0.1, -0.2, 0.3, 0.0], dtype=np.float32)


def write(path: Path, size: tuple[int, int] = (32, 64), *, inputs: int = 1, quantised: bool = False) -> Path:
    """Write conv 3x3 with stride 2, NHWC, from images (1, h, w, 3) to logits (1, h / 2, w / 2, 4).

    If `quantised`, the image is uint8 q of the real values 2 (q - 128) / 255 and goes through a DEQUANTIZE.
    """
    made = schema.ModelT()
    made.version = 3
    made.buffers = [schema.BufferT()]
    graph = schema.SubGraphT()
    graph.tensors, graph.operators = [], []
    kinds = schema.TensorType

    def tensor(name: str, shape: tuple[int, ...], values: np.ndarray | None = None, kind: int = kinds.FLOAT32) -> int:
        made_tensor = schema.TensorT()
        made_tensor.name, made_tensor.shape, made_tensor.type, made_tensor.buffer = name, list(shape), kind, 0
        if values is not None:
            buffer = schema.BufferT()
            buffer.data = np.frombuffer(values.tobytes(), np.uint8)
            made.buffers.append(buffer)
            made_tensor.buffer = len(made.buffers) - 1
        graph.tensors.append(made_tensor)
        return len(graph.tensors) - 1

    def operator(code: int, version: int, inside: list[int], out: int) -> schema.OperatorT:
        kind = schema.OperatorCodeT()
        kind.builtinCode, kind.deprecatedBuiltinCode, kind.version = code, code, version
        made.operatorCodes.append(kind)
        made_operator = schema.OperatorT()
        made_operator.opcodeIndex, made_operator.inputs, made_operator.outputs = (
            len(made.operatorCodes) - 1,
            inside,
            [out],
        )
        graph.operators.append(made_operator)
        return made_operator

    made.operatorCodes = []
    height, width = size
    image = tensor("image", (1, height, width, 3), kind=kinds.UINT8 if quantised else kinds.FLOAT32)
    graph.inputs = [image, *(tensor(f"image{k}", (1, 2)) for k in range(1, inputs))]
    real = image
    if quantised:
        scale = schema.QuantizationParametersT()
        scale.scale, scale.zeroPoint = [2 / 255], [128]
        graph.tensors[image].quantization = scale
        real = tensor("real", (1, height, width, 3))
        operator(schema.BuiltinOperator.DEQUANTIZE, 1, [image], real)
    weights, bias = tensor("weights", WEIGHTS.shape, WEIGHTS), tensor("bias", BIAS.shape, BIAS)
    logits = tensor("logits", (1, height // 2, width // 2, 4))
    conv = operator(schema.BuiltinOperator.CONV_2D, 1, [real, weights, bias], logits)
    options = schema.Conv2DOptionsT()
    options.padding, options.strideH, options.strideW = schema.Padding.SAME, 2, 2
    options.dilationHFactor = options.dilationWFactor = 1
    conv.builtinOptionsType, conv.builtinOptions = schema.BuiltinOptions.Conv2DOptions, options
    graph.outputs = [logits]
    made.subgraphs = [graph]
    builder = flatbuffers.Builder(1024)
    builder.Finish(made.Pack(builder), b"TFL3")
    path.write_bytes(bytes(builder.Output()))
    return path
