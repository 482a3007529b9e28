"""Policies as files for other programs: ONNX or TorchScript, with a description and the model."""
