"""What every storey stands on: errors, names, texts, resources."""
