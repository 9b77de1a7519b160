"""Match corners of several views, and propose points and edges: epipolar curves, tracks."""
