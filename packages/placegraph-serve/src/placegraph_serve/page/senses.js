// Ears, compass and satellites of the device: each asked for only when its button is pressed.

const press = (button, on) => button.setAttribute("aria-pressed", String(on));

/** Speech, where the browser can hear; it may ask a service of its maker, and that is said. */
export function voice(button, { heard, said }) {
  const Recognition = window.SpeechRecognition ?? window.webkitSpeechRecognition;
  if (!Recognition) return;
  button.hidden = false;
  let ear = null;
  button.addEventListener("click", () => {
    if (ear) { ear.stop(); return; }
    ear = new Recognition();
    ear.lang = navigator.language;
    ear.interimResults = true;
    ear.continuous = false;
    said("Listening. Your browser may send the recording to its vendor's service; this server receives only the text.");
    press(button, true);
    ear.onresult = ({ results }) => heard([...results].map(([best]) => best.transcript).join(" ").trim(),
      results[results.length - 1].isFinal);
    ear.onerror = ({ error }) => said({
      "not-allowed": "The browser is not allowed to use the microphone; allow it for this page.",
      "no-speech": "Nothing was heard.", network: "The browser's speech service cannot be reached; type instead.",
    }[error] ?? `The browser could not listen (${error}).`);
    ear.onend = () => { ear = null; press(button, false); };
    ear.start();
  });
}

/** Where the device is, as a prior. */
export function position(button, { here, said }) {
  if (!navigator.geolocation) return;
  button.hidden = false;
  let watch = null;
  const stop = () => {
    if (watch !== null) navigator.geolocation.clearWatch(watch);
    watch = null;
    press(button, false);
    here(null);
  };
  button.addEventListener("click", () => {
    if (watch !== null) { stop(); said(""); return; }
    if (!isSecureContext) {
      said("Browsers share their position only with https:// pages and pages of this computer; open the page that way.");
      return;
    }
    press(button, true);
    said("Requesting the device's position …");
    watch = navigator.geolocation.watchPosition(({ coords }) => {
      said("");
      here({ near: [coords.longitude, coords.latitude], radius: Math.max(150, 2 * coords.accuracy), accuracy: coords.accuracy });
    }, ({ code }) => {
      stop();
      said(code === 1 ? "The browser is not allowed to share its position; allow it for this page." : "The device has no position; choose a point on the map instead.");
    }, { enableHighAccuracy: true, maximumAge: 5000, timeout: 20000 });
  });
  return stop;
}

/** Where the device points, clockwise from north [deg]. */
export function compass(button, { towards, said }) {
  const Orientation = window.DeviceOrientationEvent;
  if (!Orientation || !navigator.maxTouchPoints) return;
  button.hidden = false;
  let on = false, last = null;
  const turn = (event) => {
    const heading = event.webkitCompassHeading ?? (event.absolute && event.alpha !== null ? 360 - event.alpha : null);
    if (heading === null) return;
    const upright = (heading + (screen.orientation?.angle ?? 0) + 360) % 360;
    if (last !== null && Math.abs(((upright - last + 540) % 360) - 180) < 8) return;
    last = upright;
    said("");
    towards(Math.round(upright));
  };
  const stop = () => {
    on = false;
    last = null;
    for (const kind of ["deviceorientationabsolute", "deviceorientation"]) removeEventListener(kind, turn);
    press(button, false);
    towards(null);
  };
  button.addEventListener("click", async () => {
    if (on) { stop(); said(""); return; }
    if (Orientation.requestPermission && (await Orientation.requestPermission().catch(() => "denied")) !== "granted") {
      said("The browser is not allowed to share its heading; allow it for this page.");
      return;
    }
    on = true;
    press(button, true);
    said("Point the device in your viewing direction. If nothing happens, it has no compass.");
    for (const kind of ["deviceorientationabsolute", "deviceorientation"]) addEventListener(kind, turn);
  });
  return stop;
}
