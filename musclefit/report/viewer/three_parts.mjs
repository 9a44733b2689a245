// The parts of three.js that the viewer uses; `npm run build` bundles them into three.min.js.
export {
  AmbientLight, Box3, BufferAttribute, BufferGeometry, Color, DirectionalLight, DoubleSide, Group, HemisphereLight,
  Mesh, MeshBasicMaterial, MeshLambertMaterial, OrthographicCamera, Plane, Points, PointsMaterial, Raycaster, Scene,
  Sphere, Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
