"""ESPNetv2, trained on Cityscapes, for who segments without a large network."""
