"""The geoms of a compiled scene: by name, and as meshes where they stand."""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.fidelity.meshes import concatenate_meshes


def load_model(scene: Path) -> mujoco.MjModel:
    """Compiles an MJCF file and keeps nothing else of it.

    `MjModel.from_xml_path` gives the same model, but MuJoCo then keeps the parsed file, and the meshes that it read:
    0.45 GiB for a bore of 351 m.

    Raises:
        ValueError: MuJoCo refuses it.
    """
    mujoco.mj_setCacheCapacity(mujoco.mj_getCache(), 0)
    return mujoco.MjSpec.from_file(str(scene)).compile()


@dataclass(frozen=True)
class Geoms:
    """Geoms of a compiled scene at the model's first pose."""

    model: mujoco.MjModel  # The scene
    data: mujoco.MjData  # Its placed data
    names: tuple[str, ...]  # Name of each geom, by number

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "Geoms":
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        return cls(model, data, tuple(model.geom(geom).name for geom in range(model.ngeom)))

    def named(self, *firsts: str) -> list[int]:
        """Return the numbers of the geoms whose name up to the first `_` is one of these."""
        return [geom for geom, name in enumerate(self.names) if name.split("_")[0] in firsts]

    def joined(self, prefix: str, group: int | None = None) -> trimesh.Trimesh:
        """Return the geoms whose name begins with a prefix, of one group or of all, as one mesh."""
        meshes = [self.mesh(geom) for geom, name in enumerate(self.names) if name.startswith(prefix)
                  and group in (None, self.model.geom_group[geom])]  # fmt: skip
        return concatenate_meshes(meshes)

    def mesh(self, geom: int) -> trimesh.Trimesh:
        """Return a box or mesh geom as triangles in the world frame, m.

        Raises:
            ValueError: Another kind of geom.
        """
        model, kind = self.model, self.model.geom_type[geom]
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            mesh = trimesh.creation.box(2.0 * model.geom_size[geom])
        elif kind == mujoco.mjtGeom.mjGEOM_MESH:
            k = model.geom_dataid[geom]
            vertices = model.mesh_vert[model.mesh_vertadr[k] : model.mesh_vertadr[k] + model.mesh_vertnum[k]]
            faces = model.mesh_face[model.mesh_faceadr[k] : model.mesh_faceadr[k] + model.mesh_facenum[k]]
            mesh = trimesh.Trimesh(vertices.astype(float), faces, process=False)
        else:
            raise ValueError(f"geom {self.names[geom]} is neither a box nor a mesh")
        placement = np.eye(4)
        placement[:3, :3] = Rotation.from_matrix(self.data.geom_xmat[geom].reshape(3, 3)).as_matrix()
        placement[:3, 3] = self.data.geom_xpos[geom]
        mesh.apply_transform(placement)
        return mesh
