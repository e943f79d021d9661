"""Networks: layers, training loop and files of weights. Only these modules import torch."""
