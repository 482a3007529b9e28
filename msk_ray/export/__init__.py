"""Policies as files that other programs run: ONNX or TorchScript, with a description and the model beside them."""
