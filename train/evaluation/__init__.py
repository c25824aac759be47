"""Evaluation: metrics, retrieval baselines, inference with a trained network, and evaluation.json."""
