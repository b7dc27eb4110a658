% The scene of the tests in Psychtoolbox, in meters and linear light; ends when
% $SCENE_END exists.
%
% SCENE_KEYWORDS has keywords of PsychVRHMD, by which its driver selects who submits
% frames: the main thread, or a presenter thread without a context of OpenGL.
more off;
global GL
PsychDefaultSetup(2);
Screen('Preference', 'SkipSyncTests', 2);
Screen('Preference', 'VisualDebugLevel', 1);
Screen('Preference', 'SuppressAllWarnings', 1);
Screen('Preference', 'Verbosity', 3);
InitializeMatlabOpenGL;
PsychImaging('PrepareConfiguration');
hmd = PsychVRHMD('AutoSetupHMD', 'Tracked3DVR', getenv('SCENE_KEYWORDS'), 0);
[win, rect] = PsychImaging('OpenWindow', max(Screen('Screens')), 0);
[proj{1}, proj{2}] = PsychVRHMD('GetStaticRenderParameters', hmd, 0.05, 20);

function stripes(n, width, bottom, top, z)
  global GL
  for i = 0:n - 1
    gray = .0144 + .857 * mod(i, 2);
    glColor3f(gray, gray, gray);
    left = (i - n / 2) * width;
    right = left + width;
    glBegin(GL.QUADS);
    glVertex3f(left, bottom, z); glVertex3f(right, bottom, z);
    glVertex3f(right, top, z); glVertex3f(left, top, z);
    glEnd;
  end
end

function box(x, y, z, side, color)
  glColor3f(color(1), color(2), color(3));
  glPushMatrix; glTranslatef(x, y, z); glutSolidCube(side); glPopMatrix;
end

Screen('BeginOpenGL', win);
scene = glGenLists(1);
glNewList(scene, GL.COMPILE);
stripes(100, .08, .25, 2.25, -6);
stripes(60, .0035, -.065, -.015, -.25);
box(-.25, -.4, -1, .2, [.631, .0144, .0144]);
box(.25, -.4, -1, .2, [.0144, .0513, .631]);
glEndList;
Screen('EndOpenGL', win);

n = 0;
while ~exist(getenv('SCENE_END'), 'file')
  state = PsychVRHMD('PrepareRender', hmd);
  for eye = 0:1
    Screen('SelectStereoDrawbuffer', win, eye);
    Screen('BeginOpenGL', win);
    glClearColor(.216, .279, .352, 1); glClear();
    glEnable(GL.DEPTH_TEST);
    glMatrixMode(GL.PROJECTION); glLoadMatrixd(proj{eye + 1});
    glMatrixMode(GL.MODELVIEW); glLoadMatrixd(state.modelView{eye + 1});
    glCallList(scene);
    Screen('EndOpenGL', win);
  end
  Screen('Flip', win, [], [], 1);
  n++;
end
printf('%d frames\n', n); fflush(stdout);
sca;
