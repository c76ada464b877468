/** Starts the modules of the page. */

import "./image.js";
import "./header.js";
import "./strips.js";
import "./menus.js";
import "./exercise.js";
import "./image_tools/image_tools.js";
import "./image_tools/places.js";
import "./hand/panel.js";
import "./hand/keys.js";
import "./hand/image_drag.js";
import "./scene/scene.js";
import "./hand/scene_drag.js";
