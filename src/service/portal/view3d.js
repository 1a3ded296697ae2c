// The 3D view: surface.glb (wall and medial lines) with orbit controls. Metres, Y up, as glTF says.
import {
  AmbientLight, Box3, Color, DirectionalLight, DoubleSide, LineBasicMaterial, MeshStandardMaterial,
  PerspectiveCamera, Scene, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";

export const available = true;

const LINE_COLOURS = [0xffd166, 0x06d6a0, 0x5ab0ff, 0xef6bb5, 0xff8c42, 0xb392f0];

// Shows the bytes of surface.glb in a box. Returns a function that gives everything back.
export async function show(box, bytes) {
  const renderer = new WebGLRenderer({ antialias: true });
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  const scene = new Scene();
  const camera = new PerspectiveCamera(35, 1, 0.001, 10);
  const gltf = await new GLTFLoader().parseAsync(bytes, "");
  dress(gltf.scene);
  scene.add(gltf.scene, new AmbientLight(0xffffff, 1.2), camera);
  const lamp = new DirectionalLight(0xffffff, 2.2);
  lamp.position.set(0.4, 0.6, 1);
  camera.add(lamp);
  box.replaceChildren(renderer.domElement);
  const controls = new OrbitControls(camera, renderer.domElement);
  frame(gltf.scene, camera, controls);

  const draw = () => {
    scene.background = new Color(getComputedStyle(box).getPropertyValue("--scene").trim() || "#101418");
    renderer.render(scene, camera);
  };
  const fit = () => {
    const { clientWidth: width, clientHeight: height } = box;
    if (width === 0 || height === 0) return;
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    draw();
  };
  controls.addEventListener("change", draw);
  const observer = new ResizeObserver(fit);
  observer.observe(box);
  const scheme = window.matchMedia("(prefers-color-scheme: dark)");
  scheme.addEventListener("change", draw);
  fit();

  return () => {
    observer.disconnect();
    scheme.removeEventListener("change", draw);
    controls.dispose();
    gltf.scene.traverse((node) => {
      node.geometry?.dispose();
      node.material?.dispose();
    });
    renderer.dispose();
    renderer.forceContextLoss();
  };
}

// The wall translucent so that the medial lines inside are seen; each line in a colour of its own.
function dress(root) {
  let lines = 0;
  root.traverse((node) => {
    if (node.isMesh) {
      node.material = new MeshStandardMaterial({
        color: 0xd0564a, roughness: 0.55, metalness: 0, transparent: true, opacity: 0.55, side: DoubleSide, depthWrite: false,
      });
      node.renderOrder = 1;
    } else if (node.isLine) {
      node.material = new LineBasicMaterial({ color: LINE_COLOURS[lines % LINE_COLOURS.length] });
      lines += 1;
    }
  });
}

// The whole object in view, seen from the front of the patient.
function frame(object, camera, controls) {
  const bounds = new Box3().setFromObject(object);
  const centre = bounds.getCenter(new Vector3());
  const size = Math.max(bounds.getSize(new Vector3()).length(), 1e-6);
  const distance = size / (2 * Math.tan((camera.fov * Math.PI) / 360));
  camera.near = size / 100;
  camera.far = size * 20;
  camera.position.copy(centre).add(new Vector3(0.25, 0.15, 1).normalize().multiplyScalar(distance));
  camera.updateProjectionMatrix();
  controls.target.copy(centre);
  controls.update();
}
