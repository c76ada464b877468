"""Sequences written field by field, as Plus writes them."""

import numpy as np

__all__ = ["write_sweep"]


def write_sweep(path, images, matrices, *, name="ImageToReference", rate=20.0, **more):
    """A MetaImage sequence of images (K, rows, columns) and transforms (K, 4, 4) to metres."""
    count, rows, columns = images.shape
    lines = ["ObjectType = Image", "NDims = 3", f"DimSize = {columns} {rows} {count}"]
    lines += ["ElementType = MET_UCHAR", "UltrasoundImageOrientation = MF"]
    lines += [f"{key} = {value}" for key, value in more.items()]
    for k, matrix in enumerate(matrices):
        millimetres = matrix.copy()
        millimetres[:3] *= 1e3
        numbers = " ".join(f"{x:.17g}" for x in millimetres.ravel())
        lines += [f"Seq_Frame{k:04d}_{name}Transform = {numbers}"]
        lines += [f"Seq_Frame{k:04d}_Timestamp = {k / rate:.6f}"]
    text = "\n".join([*lines, "ElementDataFile = LOCAL", ""])
    path.write_bytes(text.encode() + np.ascontiguousarray(images).tobytes())
    return path
