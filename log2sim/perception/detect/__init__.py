"""2D detection of road users in camera frames: ONNX models, or the boxes that a log brings."""
