"""How good poses are: errors, recall, pose files, report. Pure arrays in, models and files out."""
