"""The experiments of the paper and their baselines: photographs in, hit rates out.

Source: Czúni and Rashad, "Lightweight Active Object Retrieval with Weak Classifiers", Sensors 2018, 18, 801, section 6.
"""
