"""The paper's retrieval: exact Tanimoto search, Hough voting (HBR) and the next view (AHBR)."""
