"""Export: from a training checkpoint to an ONNX model that carries its contract, proven equal before it is written."""
