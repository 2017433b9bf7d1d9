"""What a posterior is good for: where a pixel points, with its error, in files for other tools."""
