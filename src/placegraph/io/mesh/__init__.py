"""Meshes and 3D scene graphs: glTF, OBJ, PLY, Spark-DSG."""
