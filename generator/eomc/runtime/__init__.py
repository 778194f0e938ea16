"""What a compiled model needs at run time, copied into its folder; imports nothing of eomc."""
