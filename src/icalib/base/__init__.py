"""What every package may use: files, YAML with line numbers, optional packages, the compiler of kernels."""
