"""Training of the pose networks. The only part of the project that needs PyTorch (the `train` extra)."""
