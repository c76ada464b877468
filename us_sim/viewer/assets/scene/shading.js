/**
 * Soft light, computed at vertices: cheap enough for a processor that draws.
 *
 * The lights go with the camera, so that nothing is ever seen in the dark. Colours are those of
 * the screen throughout.
 */

import { THREE } from "nicegui-scene";

const VERTEX = /* glsl */ `
  uniform vec3 colour;
  uniform float opacity;
  uniform float rim;
  uniform float gloss;
  varying vec4 shade;
  varying vec3 place;
  void main() {
    vec4 seen = modelViewMatrix * vec4(position, 1.0);
    vec3 eye = normalize(-seen.xyz);
    vec3 n = normalize(normalMatrix * normal);
    float facing = dot(n, eye);
    n = facing < 0.0 ? -n : n;
    facing = abs(facing);
    float key = 0.5 + 0.5 * dot(n, normalize(vec3(-0.45, 0.75, 0.55)));
    float fill = 0.5 + 0.5 * dot(n, normalize(vec3(0.8, -0.1, 0.5)));
    float light = 0.22 + 0.72 * key * key + 0.16 * fill;
    float shine = gloss * pow(max(0.0, dot(n, normalize(vec3(-0.25, 0.5, 1.0)))), 24.0);
    float edge = 1.0 - facing;
    edge *= edge;
    shade = vec4(colour * light + shine, mix(opacity, min(1.0, opacity + rim), edge));
    place = (modelMatrix * vec4(position, 1.0)).xyz;
    gl_Position = projectionMatrix * seen;
  }
`;

const FRAGMENT = /* glsl */ `
  uniform vec4 cut;
  varying vec4 shade;
  varying vec3 place;
  void main() {
    if (dot(cut.xyz, place) > cut.w) discard;
    gl_FragColor = shade;
  }
`;

/** A plane beyond which nothing is. */
const NEVER = new THREE.Vector4(0, 0, 0, 1);

/**
 * A material of one colour.
 *
 * `opacity` of what is seen face on, `rim` how much more at its edge, `gloss` of its highlight, 0
 * to 1 each. What lies beyond the plane `cut` (normal, distance in m) is left out.
 */
export function softMaterial(colour, { opacity = 1, rim = 0, gloss = 0.15, cut = NEVER } = {}) {
  const { r, g, b } = new THREE.Color().setStyle(colour, THREE.LinearSRGBColorSpace);
  const material = new THREE.ShaderMaterial({
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    uniforms: {
      colour: { value: new THREE.Vector3(r, g, b) },
      opacity: { value: opacity },
      rim: { value: rim },
      gloss: { value: gloss },
      cut: { value: cut },
    },
    side: THREE.DoubleSide,
  });
  setOpacity(material, opacity);
  return material;
}

/** Make a material more or less transparent; what is transparent hides nothing behind it. */
export function setOpacity(material, opacity) {
  material.uniforms.opacity.value = opacity;
  material.transparent = opacity < 0.995;
  material.depthWrite = !material.transparent;
  material.needsUpdate = true;
}

/** Red, green and blue, 0 to 1, as a style. */
export function styleOf([r, g, b]) {
  const byte = (value) => Math.round(255 * value);
  return `rgb(${byte(r)}, ${byte(g)}, ${byte(b)})`;
}
