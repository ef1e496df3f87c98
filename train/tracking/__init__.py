"""What a run leaves behind of its course: scalars for TensorBoard, W&B and files, and the curves drawn from them."""
