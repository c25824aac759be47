"""Front constraint against projection losses, on free point clouds and in networks. Start reading at experiment.py."""
