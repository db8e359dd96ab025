"""Evaluation of poses: errors, recall, comparison, pose files and their check, reports."""
