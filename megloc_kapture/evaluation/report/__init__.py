"""Reports: one document model, rendered as text, JSON, CSV and HTML."""
