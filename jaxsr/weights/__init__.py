"""Files of weights: ours (safetensors), those that other programs wrote, and the released ones."""
